"""What symmetry gains by kind of break: grouping, means, few runs, the defects of the cells."""

import re

import pytest

from symsteer.leaderboard.sections.what_symmetry_gains import SECTION, gains, kinds
from tests.leaderboard.record_factory import audit_of, make_cell, summary_of, view_of

RATES = {"standard": 0.5, "augmented": 0.6, "equivariant": 0.8}


def test_kinds_keep_apart_what_breaks_budgets_demonstrations_and_times() -> None:
    places = [
        {"variant": "none"},
        {"variant": "none", "task": "PushCube-v1"},
        {"variant": "wind:0.5"},
        {"variant": "wind:1"},
        {"variant": "wind:1@0.5"},
        {"variant": "lab_break:1"},
        {"variant": "none", "embodiment": "panda"},
        {"variant": "wind:1", "embodiment": "panda"},
        {"variant": "wind:1", "env_steps": 500_000},
        {"variant": "none", "demonstrations": {"mode": "diverse", "seed": 0, "count": 5}},
    ]
    found = kinds(summary_of(*(make_cell(RATES, 2, **place) for place in places)))
    assert {kind: len(tables) for kind, tables in found.items()} == {
        "unbroken": 2,
        "unbroken, few demonstrations": 1,
        "wind on the object": 2,
        "wind on the object, changing": 1,
        "`lab_break`": 1,
        "arm": 1,
        "arm, wind on the object": 1,
        "wind on the object, 500\u00a0k steps": 1,
    }
    assert next(iter(found)) == "unbroken"


def test_gains_are_means_over_cells_with_enough_runs() -> None:
    cells = make_cell(RATES), make_cell(RATES | {"equivariant": 0.6}, task="PushCube-v1")
    few = make_cell(RATES | {"equivariant": 0.0}, 4, task="StackCube-v1")
    found = {(g.agent, g.measure): g for g in gains(summary_of(*cells, few), {})}
    strict = found["equivariant", "success"]
    assert strict.effect.value == pytest.approx(0.2)
    assert (strict.cells, strict.pairs, strict.enough) == (2, 10, True)
    assert found["augmented", "success"].effect.value == pytest.approx(0.1)
    alone = next(g for g in gains(summary_of(few), {}) if g.agent == "equivariant")
    assert (alone.measure, alone.cells, alone.pairs, alone.enough) == ("auc", 1, 4, False)
    assert alone.effect.value < 0
    assert view_of(make_cell({"standard": 0.5})).blocks(SECTION) == []


def test_gains_have_the_audited_defects_of_their_cells() -> None:
    records = [make_cell(RATES, variant=f"wind:{strength}") for strength in ("0.5", "1")]
    records.append(make_cell(RATES))
    audit = audit_of({"none": 0.02, "wind:0.5": 0.1, "wind:1": 0.31})
    page = "\n".join(view_of(*records, audit=audit).blocks(SECTION))
    # Results first: the defects and the number of cells come last.
    wind = r"\| wind on the object \| [+\u2212]0.*\| 0\.10\u00a0to\u00a00\.31 \| 2 \|"
    assert re.search(wind, page)
    assert re.search(r"\| unbroken \| .*\| 0\.02 \| 1 \|", page)
    # One cell that was not audited: then the range would not be that of all.
    found = {gain.kind: gain for gain in gains(summary_of(*records), audit_of({"wind:1": 0.31}))}
    assert found["wind on the object"].defects is None
