"""What symmetry gains by kind of break: grouping, means, few runs; the list of records."""

import csv
import io
from pathlib import Path

import pytest

from symsteer.leaderboard.answer import gains, kinds
from symsteer.leaderboard.answer_page import gains_section
from symsteer.leaderboard.findings import analyse
from symsteer.leaderboard.listing import render_records
from symsteer.leaderboard.records import RunRecord
from symsteer.leaderboard.study import PAPER, read_study
from symsteer.leaderboard.summary import Run, Summary, summarize
from tests.leaderboard.record_factory import make_cell
from tests.leaderboard.test_defects import audit_of

RATES = {"standard": 0.5, "augmented": 0.6, "equivariant": 0.8}


def summary_of(records: list[RunRecord]) -> Summary:
    return summarize([Run(Path(f"{i}.json"), record) for i, record in enumerate(records)])


def test_kinds_keep_apart_what_breaks_budgets_demonstrations_and_times() -> None:
    count = {"mode": "diverse", "seed": 0}
    places = [
        {"variant": "none"},
        {"variant": "none", "task": "PushCube-v1"},
        {"variant": "wind:0.5"},
        {"variant": "wind:1"},
        {"variant": "wind:1@0.5"},
        {"variant": "none", "embodiment": "panda"},
        {"variant": "wind:1", "embodiment": "panda"},
        {"variant": "wind:1", "env_steps": 500_000},
        {"variant": "none", "demonstrations": {**count, "count": 5}},
    ]
    found = kinds(summary_of([r for place in places for r in make_cell(RATES, 2, **place)]))
    assert {kind: len(tables) for kind, tables in found.items()} == {
        "unbroken": 2,
        "unbroken, few demonstrations": 1,
        "`wind`": 2,
        "`wind`, changing": 1,
        "arm": 1,
        "arm, `wind`": 1,
        "`wind`, 500\u00a0k steps": 1,
    }
    assert next(iter(found)) == "unbroken"


def test_gains_are_means_over_cells_with_enough_runs() -> None:
    records = make_cell(RATES, 5) + make_cell(RATES | {"equivariant": 0.6}, 5, task="PushCube-v1")
    few = make_cell(RATES | {"equivariant": 0.0}, 4, task="StackCube-v1")
    found = {(g.agent, g.measure): g for g in gains(summary_of(records + few), {})}
    strict = found["equivariant", "success"]
    assert strict.effect.value == pytest.approx(0.2)
    assert (strict.cells, strict.pairs, strict.enough) == (2, 10, True)
    assert found["augmented", "success"].effect.value == pytest.approx(0.1)
    (alone,) = [
        g for g in gains(summary_of(few), {}) if (g.agent, g.measure) == ("equivariant", "auc")
    ]
    assert (alone.cells, alone.pairs, alone.enough) == (1, 4, False)
    assert alone.effect.value < 0
    assert gains(summary_of(make_cell({"standard": 0.5}, 5)), {}) == []


def test_gains_have_the_audited_defects_of_their_cells() -> None:
    weak, strong = (make_cell(RATES, 5, variant=f"wind:{strength}") for strength in ("0.5", "1"))
    summary = summary_of(weak + strong + make_cell(RATES, 5))
    defects = {"none": 0.02, "wind:0.5": 0.1, "wind:1": 0.31}
    found = {gain.kind: gain for gain in gains(summary, audit_of(defects))}
    assert found["`wind`"].defects == (0.1, 0.31)
    assert found["unbroken"].defects == (0.02, 0.02)
    page = "\n".join(gains_section(analyse(summary, audit_of(defects), read_study(PAPER))))
    assert "| `wind` | 0.10\u00a0to\u00a00.31 | 2 |" in page
    assert "| unbroken | 0.02 | 1 |" in page
    # One cell that was not audited: then the range would not be that of all.
    found = {gain.kind: gain for gain in gains(summary, audit_of({"wind:1": 0.31}))}
    assert found["`wind`"].defects is None


def test_every_record_has_a_line() -> None:
    records = make_cell(RATES, 2, variant="wind:1") + make_cell({"=HYPERLINK(1)": 0.5}, 1)
    summary = summary_of(records)
    rows = list(csv.DictReader(io.StringIO(render_records(summary, {}))))
    assert len(rows) == 7
    strict = [row for row in rows if row["agent"] == "equivariant"]
    assert {row["seed"] for row in strict} == {"0", "1"}
    assert {float(row["success"]) for row in strict} == {0.8}
    assert all(len(row["config_sha256"]) == 64 for row in rows)
    assert not any(value.startswith("=") for row in rows for value in row.values())
