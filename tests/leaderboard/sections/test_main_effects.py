"""Main effects of options: a fractional design, what is unbalanced, what does not vary."""

import itertools
from collections.abc import Sequence

import pytest

from symsteer.leaderboard.records import RunRecord
from symsteer.leaderboard.sections.main_effects import SECTION, MainEffect, main_effects
from tests.leaderboard.record_factory import make_cell, summary_of, view_of


def effects(records: list[RunRecord]) -> dict[tuple[str, str], MainEffect]:
    found = main_effects(summary_of(records))
    return {(one.option, one.measure): one for one in found if one.agent == "standard"}


def design(skip: int | None = None, agents: Sequence[str] = ("standard",)) -> list[RunRecord]:
    """Half of the grid of four options: success 0.5, +0.2 with LayerNorm, -0.1 with 4 updates."""
    records = []
    for index, (utd, norm, tau) in enumerate(itertools.product((0, 1), repeat=3)):
        if index == skip:
            continue
        options = {
            "utd": (1.0, 4.0)[utd],
            "layer_norm": bool(norm),
            "tau": (0.005, 0.05)[tau],
            "soft_backup": bool(utd ^ norm ^ tau),
            "width": 128,
        }
        cell = dict.fromkeys(agents, 0.5 + 0.2 * norm - 0.1 * utd)
        for variant in ("none", "wind:1"):
            records += make_cell(cell, variant=variant, agent_options=options)
    return records


@pytest.mark.parametrize("agents", [("standard",), ("standard", "equivariant")])
def test_a_fraction_of_the_grid_gives_the_main_effects(agents: Sequence[str]) -> None:
    """Whether its settings are rows of one table, or tables that two learners share."""
    found = effects(design(agents=agents))
    assert {option for option, _ in found} == {"utd", "layer_norm", "tau", "soft_backup"}
    norm = found["layer_norm", "success"]
    assert norm.effect.value == pytest.approx(0.2)
    assert (norm.levels, norm.runs) == (("false", "true"), 80)
    assert norm.means == pytest.approx((0.45, 0.65))
    assert found["utd", "success"].effect.value == pytest.approx(-0.1)
    assert found["utd", "success"].levels == ("1.0", "4.0")
    for option in ("tau", "soft_backup"):
        assert found[option, "success"].effect.value == pytest.approx(0, abs=1e-9)
    assert found["tau", "magnitude"].effect.value == pytest.approx(0)


def test_the_page_has_both_means_and_their_difference() -> None:
    _, table = view_of(design()).blocks(SECTION)
    (row,) = [line for line in table.replace("\u00a0", " ").splitlines() if "`layer_norm`" in line]
    assert "| `standard` | `layer_norm` `false` to `true` | 0.45 to 0.65<br>+0.20<br>[" in row


def test_what_is_not_balanced_is_no_design() -> None:
    assert not effects(design(skip=3))
    grids: list[list[dict[str, float]]] = [
        [{"tau": 0.1}],
        [{"tau": 0.1}, {"tau": 0.2}],
        # One option at a time: each policy has all values of one option only.
        [{"tau": 0.1, "utd": 1.0}, {"tau": 0.2, "utd": 1.0}, {"tau": 0.1, "utd": 4.0}],
    ]
    for grid in grids:
        assert not effects([r for o in grid for r in make_cell({"standard": 0.5}, agent_options=o)])
