"""A map whose answer is known: what `equivariant` gains falls with the defect, and ends at 0.3."""

from __future__ import annotations

from collections.abc import Mapping

import pytest

from symsteer.leaderboard.defects import Audit
from symsteer.leaderboard.rows import Summary
from tests.leaderboard.record_factory import audit_of, steered, summary_of

DEFECTS = {"none": 0.0, "wind:0.25": 0.1, "wind:0.5": 0.2, "obstacle:1": 0.35, "wind:1": 0.5}
TASKS = ("A-v1", "B-v1", "C-v1", "D-v1", "E-v1")


def crossing(offsets: Mapping[str, float], policies: int = 5) -> tuple[Summary, Audit]:
    """`equivariant` gains 0.3 less the defect, and a task's offset; `approximate` 0.1."""
    records, audit = [], {}
    for task, offset in offsets.items():
        rates = {v: (0.4, 0.7 - defect + offset, 0.5) for v, defect in DEFECTS.items()}
        records += steered(rates, policies, task=task)
        audit |= audit_of(DEFECTS, width=0.01, task=task)
    return summary_of(records), audit


@pytest.fixture(scope="session")
def map_of_five() -> tuple[Summary, Audit]:
    return crossing(dict(zip(TASKS, (0.0, 0.025, -0.025, 0.05, -0.05), strict=True)))
