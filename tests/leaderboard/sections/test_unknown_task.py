"""The section on tasks that are left out."""

from __future__ import annotations

from symsteer.leaderboard.sections.unknown_task import SECTION
from tests.leaderboard.record_factory import make_cell, view_of, with_policies


def test_rules_are_shown_with_their_refusals() -> None:
    rates = {"base": 0.2, "equivariant": 0.8, "standard": 0.5}
    cells = [
        with_policies(make_cell(rates, task=task, variant="wind:1"))
        for task in ("A-v1", "B-v1", "C-v1")
    ]
    explained, table = view_of(*cells).blocks(SECTION)
    assert "without the runs of its task" in explained
    rows = [row.strip("| ").split(" | ") for row in table.splitlines()]
    assert ["kind", "success", "3", "3", "3/3", "3/3"] in [row[:6] for row in rows]
    # Nobody played the best constant noise.
    assert not [row for row in rows if row[0] == "probe"]


def test_without_both_agents_there_is_no_section() -> None:
    assert view_of(make_cell({"base": 0.2, "standard": 0.5})).blocks(SECTION) == []
