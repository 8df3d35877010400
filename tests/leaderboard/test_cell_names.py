"""Cells are called in words, each by a name of its own; texts of records stay in code spans."""

from __future__ import annotations

import pytest

from symsteer.leaderboard.cell_names import cell_name
from tests.leaderboard.record_factory import make_cell, summary_of


@pytest.mark.parametrize(
    ("variant", "embodiment", "name"),
    [
        ("none", "floating", "PickCube, unbroken"),
        ("action_gain:0.5", "floating", "PickCube, action gain 0.5"),
        ("wind:0.2..0.8+obstacle:1", "panda", "PickCube, panda arm, wind 0.2 to 0.8, obstacle 1"),
        ("wind:1@0.25..0.75", "floating", "PickCube, wind 1 from 0.25 to 0.75 of the budget"),
        ("<b>", "a|b", "PickCube, `a\u00a6b` arm, `<b>`"),
        ("<b>:1", "floating", "PickCube, `<b>` 1"),
    ],
)
def test_a_cell_is_named_in_words(variant: str, embodiment: str, name: str) -> None:
    summary = summary_of(make_cell({"base": 0.5}, seeds=1, variant=variant, embodiment=embodiment))
    assert cell_name(summary.tables[0], summary) == name
