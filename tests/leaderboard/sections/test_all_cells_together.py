"""Profiles and probabilities of improvement from records: which runs and cells they compare."""

from __future__ import annotations

import pytest

from symsteer.leaderboard.sections.performance_profiles import THRESHOLDS, gap_closed, profiles
from symsteer.leaderboard.sections.probability_of_improvement import SECTION, improvements
from tests.leaderboard.record_factory import (
    make_cell,
    make_evaluation,
    make_record,
    summary_of,
    table_after,
    view_of,
)


def test_the_gap_is_measured_on_the_same_episodes() -> None:
    base = make_record([make_evaluation([1, 0, 0, 0], 0)], agent="base")
    better = make_record([make_evaluation([1, 1, 0, 0])])
    worse = make_record([make_evaluation([0, 0, 0, 0])], seed=1)
    # The first two episodes alone, of which the base solves one.
    short = make_record([make_evaluation([1, 1])], seed=2)
    perfect = make_record([make_evaluation([1, 1, 1, 1], 0)], agent="base")
    for reference, gaps in ((base, [1 / 3, -1 / 3, 1.0]), (perfect, [])):
        (table,) = summary_of([reference, better, worse, short]).tables
        row, base_row = table.row_of("standard"), table.row_of("base")
        assert row
        assert base_row
        found = gap_closed(row, base_row)
        assert [value for _, value in found] == pytest.approx(gaps)
        assert {policy for policy, _ in found} <= {base.base_policy.content_hash}


def test_profiles_and_pairs_by_group() -> None:
    agents = {"base": 0.5, "zero": 0.75, "standard": 0.5, "equivariant": 1.0}
    records = make_cell(agents)
    records += make_cell(agents | {"equivariant": 0.25}, variant="wind:1")
    records += make_cell({"base": 0.5, "standard": 0.5}, embodiment="panda")
    summary = summary_of(records)
    found = profiles(summary)
    unbroken = {profile.agent: profile for profile in found["unbroken"]}
    assert list(unbroken) == ["zero", "standard", "equivariant"]
    assert unbroken["equivariant"].share.tolist() == [1.0] * len(THRESHOLDS)
    zero = unbroken["zero"].share
    assert (zero[THRESHOLDS < 0.49].min(), zero[THRESHOLDS > 0.51].max()) == (1.0, 0.0)
    broken = {profile.agent: profile for profile in found["broken"]}
    assert (broken["standard"].cells, broken["standard"].runs) == (2, 10)
    assert (broken["equivariant"].cells, broken["equivariant"].runs) == (1, 5)
    (better,), (worse,) = improvements(summary).values()
    assert (better.first, better.second, better.runs) == ("equivariant", "standard", (5, 5))
    assert (better.probability.value, worse.probability.value, worse.cells) == (1.0, 0.0, 1)
    *_, table = view_of(records).blocks(SECTION)
    (_, _, row) = table_after(f"\n{table}", "|")
    assert row[0] == "`equivariant` > `standard`"
    assert [cell[-9:] for cell in row[1:]] == ["(1; 5, 5)"] * 2


def test_of_many_agents_only_pairs_with_the_plain_and_the_strict_one_are_compared() -> None:
    others = [f"other-{letter}" for letter in "abcdef"]
    agents = dict.fromkeys(["standard", "equivariant", *others], 0.5)
    assert len(improvements(summary_of(make_cell(agents)))["unbroken"]) == 28
    some = improvements(summary_of(make_cell(agents | {"other-g": 0.5})))["unbroken"]
    assert len(some) == 15
    assert all({"standard", "equivariant"} & {pair.first, pair.second} for pair in some)


def test_runs_on_policies_that_only_one_agent_steered_are_left_out() -> None:
    standard, equivariant = (
        make_cell({agent: rate}) for agent, rate in (("standard", 0.5), ("equivariant", 0.25))
    )
    for record in standard[2:]:
        record.base_policy.content_hash = "f" * 64
    (pair,) = improvements(summary_of(standard, equivariant))["unbroken"]
    assert (pair.runs, pair.probability.value) == ((5, 2), 0.0)
    for record in standard:
        record.base_policy.content_hash = "f" * 64
    assert improvements(summary_of(standard, equivariant)) == {"unbroken": []}


def test_ties_and_unfinished_runs() -> None:
    records = make_cell({"standard": 0.5, "equivariant": 0.5})
    records.append(make_record([make_evaluation([1] * 40)], "failed", seed=9))
    (pair,) = improvements(summary_of(records))["unbroken"]
    assert (pair.probability.value, pair.runs) == (0.5, (5, 5))
    assert profiles(summary_of(records)) == {"unbroken": []}
    assert profiles(summary_of(make_cell({"base": 0.5, "zero": 0.6}))) == {}
