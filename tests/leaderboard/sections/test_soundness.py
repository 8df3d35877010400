"""Soundness of learners: known falls, correlations and biases, and what the page says of them."""

from __future__ import annotations

import pytest

from symsteer.leaderboard.records import RunRecord
from symsteer.leaderboard.sections.soundness import SECTION, Soundness, of_learners
from tests.leaderboard.record_factory import make_evaluation, make_record, summary_of, view_of

EPISODES = 10
GOOD = {"q_correlation": 0.9, "q_bias": -1.5}
"""The feasible interval of the factory's records is [-20, 0]."""


def record(curve: list[float], agent: str = "standard", seed: int = 0, **measures) -> RunRecord:
    """A run with these success rates; its diagnostics are those of every evaluation."""
    evaluations = [
        make_evaluation(
            [int(i < round(EPISODES * rate)) for i in range(EPISODES)],
            50_000 * index // max(1, len(curve) - 1),
            index == len(curve) - 1,
            **measures,
        )
        for index, rate in enumerate(curve)
    ]
    return make_record(evaluations, agent=agent, seed=seed)


def measured(records: list[RunRecord]) -> Soundness:
    ((_, _, found),) = of_learners(summary_of(records))
    return found


@pytest.mark.parametrize(
    ("base", "curve", "fall"),
    [
        (0.3, [0.5, 0.6, 0.7], 0.0),  # never below its start
        (0.3, [0.5, 0.2, 0.9], 0.3),  # below its start
        (0.8, [0.5, 0.6, 0.9], 0.2),  # above its start, below its base policy
        (0.8, [0.5, 0.4, 0.9], 0.4),  # below both: the better one counts
    ],
)
def test_the_fall_is_from_the_better_of_start_and_base(base, curve, fall):
    # The run of another base policy does not count as the level of this one.
    other = record([1.0], "base", seed=1)
    other.base_policy.content_hash = "f" * 64
    found = measured([record([base], "base"), other, record(curve, **GOOD)])
    assert found.fall == pytest.approx(fall)


def test_values_are_medians_over_runs_and_the_worst_fall_is_shown():
    runs = [
        record([0.5, 0.5 - fall, 0.9], seed=seed, q_correlation=correlation, q_bias=bias)
        for seed, (fall, correlation, bias) in enumerate(
            [(0.0, 0.95, -1.0), (0.1, 0.5, 8.0), (0.4, 0.9, 1.0)]
        )
    ]
    found = measured([record([0.3], "base"), *runs])
    assert (found.fall, found.worst_fall) == pytest.approx((0.1, 0.4))
    assert (found.correlation, found.bias) == (0.9, 1.0)
    assert found.bias_share == pytest.approx(1 / 20)
    assert found.faults == []


@pytest.mark.parametrize(
    ("measures", "curve", "faults"),
    [
        (GOOD, [0.5, 0.3, 0.9], ["success falls"]),
        (GOOD | {"q_correlation": 0.7}, [0.5, 0.5, 0.9], ["Q does not follow returns"]),
        (GOOD | {"q_bias": 2.5}, [0.5, 0.5, 0.9], ["Q is biased"]),
        (GOOD, [0.5, 0.5, 0.9], []),
        ({}, [0.5, 0.5, 0.9], []),  # not measured: no fault, and not sound
    ],
)
def test_each_fault_is_named(measures, curve, faults):
    found = measured([record(curve, **measures)])
    assert (found.faults, found.is_complete) == (faults, bool(measures))


def test_the_page_has_a_row_for_each_learner_with_a_curve():
    runs = [record([0.3], "base"), record([0.5, 0.1, 0.9], **GOOD)]
    _, table = view_of(runs).blocks(SECTION)
    assert "| `standard` | 1 | 0.40 (worst 0.40) | 0.90 | 1.5 | success falls |" in table
    assert "`base` |" not in table
    assert view_of([record([0.3], "base"), record([0.9])]).blocks(SECTION) == []
