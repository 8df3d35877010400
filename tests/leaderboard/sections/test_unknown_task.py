"""The section on tasks that are left out."""

from __future__ import annotations

from dataclasses import replace

import pytest

from symsteer.leaderboard.sections.unknown_task import SECTION, verdict
from symsteer.leaderboard.study import Kind, Probe
from symsteer.leaderboard.text import NOTHING
from symsteer.leaderboard.which_agent import lessons_of
from tests.leaderboard.record_factory import make_cell, summary_of, view_of, with_policies


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


@pytest.mark.parametrize(
    ("rule", "said"),
    [
        # Above what the constant noise gains where `standard` wins: wrong there.
        (Probe(gain=0.3), "**Contradicted**: right in 1/2 by AUC and in 1/2 by success."),
        (Probe(gain=0.1), "**Supported**: right in 2/2 by AUC and in 2/2 by success."),
        (Probe(gain=-0.1), "**Contradicted**: right in 1/2 by AUC and in 1/2 by success."),
        (Kind(standard=("wind",)), "**Supported**: right in 2/2 by AUC and in 2/2 by success."),
        (
            Kind(standard=("obstacle",)),
            "**Contradicted**: right in 1/2 by AUC and in 1/2 by success.",
        ),
    ],
)
def test_a_declared_rule_is_tested_in_decided_worlds(rule: Probe | Kind, said: str) -> None:
    worlds = {
        "none": {"golden-ticket": 0.4, "equivariant": 0.8, "standard": 0.5},
        "wind:1": {"golden-ticket": 0.6, "equivariant": 0.5, "standard": 0.8},
        "wind:2": {"golden-ticket": 0.6, "equivariant": 0.5, "standard": 0.5},  # undecided
    }
    cells = [
        with_policies(make_cell({"base": 0.2, "zero": 0.4, **rates}, variant=variant))
        for variant, rates in worlds.items()
    ]
    lessons = lessons_of(summary_of(*cells))
    assert verdict(lessons, rule).endswith(said)
    assert verdict(lessons, rule.model_copy(update={"least": 2})).endswith(said)
    few = verdict(lessons, rule.model_copy(update={"least": 3}))
    assert ", of which there are at least 3. **Not tested**: right in " in few


def test_tasks_on_which_a_rule_was_found_do_not_count() -> None:
    known, new = {"equivariant": 0.5, "standard": 0.8}, {"equivariant": 0.8, "standard": 0.5}
    cells = [
        with_policies(make_cell({"base": 0.2, **rates}, task=task, variant="wind:1"))
        for task, rates in (("A-v1", known), ("B-v1", new), ("C-v1", new))
    ]
    text = verdict(lessons_of(summary_of(*cells)), Kind(standard=("wind",), found_on=("A-v1",)))
    assert "tasks on which it was not found (it was on `A-v1`)." in text
    assert "**Contradicted**: right in 0/2 by AUC and in 0/2 by success." in text
    assert text.endswith(" Of all tasks: 1/3 by AUC and in 1/3 by success.")


def test_a_rule_needs_enough_decided_worlds_by_each_measure() -> None:
    cells = [
        with_policies(make_cell({"equivariant": 0.2, "standard": 0.9}, variant=variant))
        for variant in ("wind:1", "wind:0.5")
    ]
    lessons = [
        replace(lesson, advantage={"success": lesson.advantage["success"]})
        for lesson in lessons_of(summary_of(*cells))
    ]
    right, wrong = (verdict(lessons, Kind(standard=(name,))) for name in ("wind", "obstacle"))
    assert right.endswith(f"**Not tested**: right in {NOTHING} by AUC and in 2/2 by success.")
    assert wrong.endswith(f"**Contradicted**: right in {NOTHING} by AUC and in 0/2 by success.")


def test_a_world_that_changes_in_mid_run_teaches_nothing() -> None:
    rates = {"equivariant": 0.5, "standard": 0.8}
    cells = [
        with_policies(make_cell(rates, variant=variant)) for variant in ("wind:1", "wind:1@0.3")
    ]
    assert [lesson.table.key.variant for lesson in lessons_of(summary_of(*cells))] == ["wind:1"]


def test_without_a_constant_noise_the_rule_is_not_tested() -> None:
    cell = with_policies(make_cell({"base": 0.2, "equivariant": 0.8, "standard": 0.5}))
    assert "**Not tested**" in verdict(lessons_of(summary_of(cell)), Probe(gain=0.1))
