"""Soundness of learners: known falls, correlations and biases, and what the page says of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from symsteer.leaderboard.findings import analyse
from symsteer.leaderboard.page import render_page
from symsteer.leaderboard.records import RunRecord
from symsteer.leaderboard.soundness import Soundness, soundness
from symsteer.leaderboard.study import PAPER, read_study
from symsteer.leaderboard.summary import Run, Summary, summarize
from tests.leaderboard.record_factory import make_evaluation, make_record

EPISODES = 10


def record(curve: list[float], agent: str = "standard", seed: int = 0, **measures) -> RunRecord:
    """A run with these success rates; its diagnostics are those of every evaluation."""
    budget = 50_000
    evaluations = [
        make_evaluation(
            [int(i < round(EPISODES * rate)) for i in range(EPISODES)],
            budget * index // max(1, len(curve) - 1),
            index == len(curve) - 1,
            **measures,
        )
        for index, rate in enumerate(curve)
    ]
    return make_record(evaluations, agent=agent, seed=seed)


def summary_of(records: list[RunRecord]) -> Summary:
    return summarize([Run(Path(f"{i}.json"), record) for i, record in enumerate(records)])


def measured(records: list[RunRecord]) -> Soundness:
    table = summary_of(records).tables[0]
    row = table.row_of("standard")
    assert row is not None
    return soundness(row, table)


# The feasible interval of the factory's records is [-20, 0].
GOOD = {"q_correlation": 0.9, "q_bias": -1.5}


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
    found = measured([record([base], "base"), record(curve, **GOOD)])
    assert found.fall == pytest.approx(fall)


def test_the_base_policy_is_that_of_the_run():
    """The run of another base policy does not count as the level of this one."""
    other = record([1.0], "base", seed=1)
    other.base_policy.content_hash = "f" * 64
    found = measured([record([0.3], "base"), other, record([0.4, 0.4, 0.4])])
    assert found.fall == 0


def test_values_are_medians_over_runs_and_the_worst_fall_is_shown():
    runs = [
        record([0.5, 0.5 - fall, 0.9], seed=seed, q_correlation=correlation, q_bias=bias)
        for seed, (fall, correlation, bias) in enumerate(
            [(0.0, 0.95, -1.0), (0.1, 0.5, 8.0), (0.4, 0.9, 1.0)]
        )
    ]
    found = measured([record([0.3], "base"), *runs])
    assert found.fall == pytest.approx(0.1)
    assert found.worst_fall == pytest.approx(0.4)
    assert (found.correlation, found.bias) == (0.9, 1.0)
    assert found.bias_share == pytest.approx(1 / 20)
    assert found.faults == []


@pytest.mark.parametrize(
    ("changes", "curve", "fault"),
    [
        ({}, [0.5, 0.3, 0.9], "success falls"),
        ({"q_correlation": 0.7}, [0.5, 0.5, 0.9], "Q does not follow returns"),
        ({"q_bias": 2.5}, [0.5, 0.5, 0.9], "Q is biased"),
    ],
)
def test_each_fault_is_named(changes, curve, fault):
    assert measured([record(curve, **GOOD | changes)]).faults == [fault]


def test_what_was_not_measured_is_no_fault_and_not_sound():
    found = measured([record([0.5, 0.5, 0.9])])
    assert found.faults == []
    assert not found.is_complete
    assert measured([record([0.5, 0.5, 0.9], **GOOD)]).is_complete


def page(records: list[RunRecord]) -> str:
    summary = summary_of(records)
    links = {run.path: None for run in summary.runs}
    return render_page(summary, analyse(summary, {}, read_study(PAPER)), {}, links)


def test_the_page_has_a_row_for_each_learner():
    text = page([record([0.3], "base"), record([0.5, 0.1, 0.9], **GOOD)])
    section = text.split("Are the learners sound")[1].split("</details>")[0]
    assert "| `standard` | 1 | 0.40 (worst 0.40) | 0.90 | 1.5 | success falls |" in section
    assert "`base` |" not in section


def test_the_page_leaves_the_section_out_without_learning_curves():
    assert "Are the learners sound" not in page([record([0.3], "base"), record([0.9])])
