"""Profiles and probabilities of improvement from records: which runs and cells they compare."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from symsteer.leaderboard.comparisons import THRESHOLDS, compare_agents, gap_closed
from symsteer.leaderboard.records import RunRecord
from symsteer.leaderboard.summary import Run, Summary, summarize
from tests.leaderboard.record_factory import make_cell, make_evaluation, make_record


def summary_of(records: list[RunRecord]) -> Summary:
    return summarize([Run(Path(f"{i}.json"), record) for i, record in enumerate(records)])


def test_the_gap_is_measured_on_the_same_episodes() -> None:
    base = make_record([make_evaluation([1, 0, 0, 0], 0)], agent="base")
    better = make_record([make_evaluation([1, 1, 0, 0])])
    worse = make_record([make_evaluation([0, 0, 0, 0])], seed=1)
    # The first two episodes alone, of which the base solves one.
    short = make_record([make_evaluation([1, 1])], seed=2)
    table = summary_of([base, better, worse, short]).tables[0]
    standard, reference = table.row_of("standard"), table.row_of("base")
    assert standard is not None
    assert reference is not None
    policy = base.base_policy.content_hash
    found = gap_closed(standard, reference)
    assert [on for on, _ in found] == [policy] * 3
    assert [value for _, value in found] == pytest.approx([1 / 3, -1 / 3, 1.0])
    perfect = make_record([make_evaluation([1, 1, 1, 1], 0)], agent="base")
    table = summary_of([perfect, better]).tables[0]
    standard, reference = table.row_of("standard"), table.row_of("base")
    assert standard is not None
    assert reference is not None
    assert gap_closed(standard, reference) == []


def test_profiles_and_pairs_by_group() -> None:
    agents = {"base": 0.5, "zero": 0.75, "standard": 0.5, "equivariant": 1.0}
    records = make_cell(agents)
    records += make_cell(agents | {"equivariant": 0.25}, variant="wind:1")
    records += make_cell({"base": 0.5, "standard": 0.5}, embodiment="panda")
    found = compare_agents(summary_of(records))
    assert found.cells == {"unbroken": 1, "broken": 2}
    unbroken = {profile.agent: profile for profile in found.profiles["unbroken"]}
    assert list(unbroken) == ["zero", "standard", "equivariant"]
    assert unbroken["equivariant"].share.tolist() == [1.0] * len(THRESHOLDS)
    zero = unbroken["zero"].share
    assert (zero[THRESHOLDS < 0.49].min(), zero[THRESHOLDS > 0.51].max()) == (1.0, 0.0)
    broken = {profile.agent: profile for profile in found.profiles["broken"]}
    assert (broken["standard"].cells, broken["standard"].runs) == (2, 10)
    assert (broken["equivariant"].cells, broken["equivariant"].runs) == (1, 5)
    (pair,) = found.improvements["unbroken"]
    assert (pair.first, pair.second, pair.runs) == ("equivariant", "standard", (5, 5))
    assert pair.probability.value == 1.0
    (pair,) = found.improvements["broken"]
    assert (pair.probability.value, pair.cells) == (0.0, 1)


def test_of_many_agents_only_pairs_with_the_plain_and_the_strict_one_are_compared() -> None:
    others = [f"other-{letter}" for letter in "abcdef"]
    agents = dict.fromkeys(["standard", "equivariant", *others], 0.5)
    every = compare_agents(summary_of(make_cell(agents))).improvements["unbroken"]
    assert len(every) == 28
    some = compare_agents(summary_of(make_cell(agents | {"other-g": 0.5}))).improvements["unbroken"]
    assert len(some) == 15
    assert all({"standard", "equivariant"} & {pair.first, pair.second} for pair in some)


def test_runs_on_policies_that_only_one_agent_steered_are_left_out() -> None:
    standard, equivariant = (
        make_cell({agent: rate}) for agent, rate in (("standard", 0.5), ("equivariant", 0.25))
    )
    for record in standard[2:]:
        record.base_policy.content_hash = "f" * 64
    (pair,) = compare_agents(summary_of(standard + equivariant)).improvements["unbroken"]
    assert (pair.runs, pair.probability.value) == ((5, 2), 0.0)
    for record in standard:
        record.base_policy.content_hash = "f" * 64
    assert compare_agents(summary_of(standard + equivariant)).improvements["unbroken"] == []


def test_ties_and_unfinished_runs() -> None:
    records = make_cell({"standard": 0.5, "equivariant": 0.5})
    records.append(make_record([make_evaluation([1] * 40)], "failed", seed=9))
    found = compare_agents(summary_of(records))
    (pair,) = found.improvements["unbroken"]
    assert (pair.probability.value, pair.runs) == (0.5, (5, 5))
    assert found.profiles["unbroken"] == []
    only = compare_agents(summary_of(make_cell({"base": 0.5, "zero": 0.6})))
    assert only.cells == {}


def test_the_order_of_runs_does_not_matter() -> None:
    generator = np.random.default_rng(0)
    records = [
        make_record([make_evaluation(generator.random(40) < 0.5)], agent=agent, seed=seed)
        for agent in ("base", "standard", "equivariant")
        for seed in range(5)
    ]
    runs = [Run(Path(f"{i}.json"), record) for i, record in enumerate(records)]
    first = compare_agents(summarize(runs))
    second = compare_agents(summarize(runs[::-1]))
    assert first.improvements == second.improvements
    probability = first.improvements["unbroken"][0].probability
    assert probability.low < probability.value < probability.high
    for one, other in zip(first.profiles["unbroken"], second.profiles["unbroken"], strict=True):
        np.testing.assert_array_equal(one.low, other.low)
