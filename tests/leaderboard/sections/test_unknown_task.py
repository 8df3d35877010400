"""Tasks that are left out: what is expected of them comes from the others alone."""

from __future__ import annotations

import pytest

from symsteer.leaderboard.defects import Audit
from symsteer.leaderboard.records import RunRecord
from symsteer.leaderboard.rows import Summary
from symsteer.leaderboard.sections import Findings, View
from symsteer.leaderboard.sections.unknown_task import SECTION, leave_tasks_out
from symsteer.leaderboard.study import PAPER, read_study
from tests.leaderboard.conftest import DEFECTS, TASKS, crossing
from tests.leaderboard.record_factory import audit_of, steered, summary_of


def test_what_is_expected_of_a_task_comes_from_the_others_alone() -> None:
    """Four tasks gain 0.2, one loses 0.2, whatever the defect."""
    records: list[RunRecord] = []
    audit: Audit = {}
    for task in TASKS:
        own = 0.3 if task == "E-v1" else 0.7
        records += steered(dict.fromkeys(DEFECTS, (0.5, own, 0.5)), task=task)
        audit = {**audit, **audit_of(DEFECTS, task=task)}
    found = leave_tasks_out([summary_of(records)], audit, "floating")
    assert found.tasks == TASKS
    rows = {(row.agent, row.measure): row for row in found.agents}
    row = rows["equivariant", "success"]
    # E's cells are expected at +0.2, those of the others at (3 * 0.2 - 0.2) / 4.
    assert (row.cells, row.right, row.clear, row.clear_right) == (25, 20, 25, 20)
    assert row.error == pytest.approx((0.4 + 4 * 0.1) / 5)
    # Four tasks that agree have no spread, so E lies outside; with E among them all lie inside.
    assert (row.with_interval, row.inside) == (25, 20)
    (best,) = [best for best in found.best if best.measure == "success"]
    assert (best.cells, best.right, best.usual) == (25, 20, 20)


def test_the_expected_best_agent_beats_the_usual_one(map_of_five: tuple[Summary, Audit]) -> None:
    """Below a defect of 0.2 one agent is best, above it the other; the page says so."""
    view = View(Findings(*map_of_five, read_study(PAPER)))
    (tested,) = view.findings.of(SECTION)
    for best in tested.best:
        assert best.cells == 25
        # At the crossing itself both are equal.
        assert best.right >= 20
        assert best.usual <= 15
    for row in tested.agents:
        assert row.error < 0.06
        assert row.inside >= 0.9 * row.with_interval
    _, _, table, sentence = view.blocks(SECTION)
    first, by_area = tested.agents[0], tested.best[0]
    assert f"| `equivariant` | AUC | {first.right}/{first.cells} |" in table
    assert f"by AUC in {by_area.right}/{by_area.cells} cells (the agent" in sentence


def test_one_task_cannot_be_left_out() -> None:
    found = leave_tasks_out(
        [crossing({"A-v1": 0.0})[0]], audit_of(DEFECTS, task="A-v1"), "floating"
    )
    assert (found.tasks, found.agents, found.best) == (("A-v1",), (), ())
