"""Curves over steps and over directions."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from symsteer.leaderboard.curves import curves_as_text, direction_curve
from symsteer.leaderboard.records import write_record
from tests.leaderboard.record_factory import make_evaluation, make_record, summary_of


def row_of(*runs):
    """The row of runs that are given as successes and directions in degrees."""
    records = []
    for seed, (successes, degrees) in enumerate(runs):
        evaluation = make_evaluation(successes)
        if degrees is not None:
            radians = [None if d is None else math.radians(d) for d in degrees]
            evaluation.episodes.direction = radians
        records.append(make_record([evaluation], agent="base", seed=seed))
    return summary_of(records).tables[0].rows[0]


def test_successes_are_counted_in_sectors():
    curve = direction_curve(row_of(([1, 0, 1, 1, 0], [0, 20, 30, 179, -179])))
    assert curve.steps == [-180, 0, 45, 180]
    assert curve.values == pytest.approx([0.5, 0.5, 1, 0.5])
    assert all(a <= b <= c for a, b, c in zip(curve.low, curve.values, curve.high, strict=True))
    # Wilson's interval of one success.
    assert curve.low[2] < 0.3 < curve.high[2] == 1


@pytest.mark.parametrize(
    ("runs", "values"),
    [
        # Each run counts once.
        ([([1, 1, 1], [90, 90, 91]), ([0], [90])], [0.5]),
        # Episodes and runs without a direction do not count.
        ([([1, 0, 1], [90, None, 91]), ([0], None)], [1]),
    ],
)
def test_runs_count_alike(runs, values):
    assert direction_curve(row_of(*runs)).values == values
    assert direction_curve(row_of(([1, 0], None))) is None


def test_learners_have_a_curve_and_references_one_number(tmp_path: Path):
    learning = [
        make_evaluation([0, 0, 0, 1], 0, final=False),
        make_evaluation([1, 1, 0, 0], 5_016, final=False),
        make_evaluation([1, 1, 1, 1], 10_032),
    ]
    slower = [
        make_evaluation([0, 0, 0, 1], 0, final=False),
        make_evaluation([0, 0, 0, 0], 5_040, final=False),
        make_evaluation([1, 1, 1, 0], 10_000),
    ]
    records = [
        make_record(learning, seed=0, env_steps=10_000),
        make_record(slower, seed=1, env_steps=10_000),
        make_record([make_evaluation([1, 0, 1, 0], 3)], agent="base", env_steps=10_000),
        make_record(learning[:2], "interrupted", seed=2, env_steps=10_000),
    ]
    for record in records:
        write_record(record, tmp_path / f"{record.run_id}.json")
    title, head, base, standard = curves_as_text([tmp_path]).splitlines()
    assert title == "PickCube-v1 floating, unbroken"
    assert head.split() == ["success", "after", "steps", "0k", "5k", "10k"]
    assert base.split() == ["base", "50%"]
    assert len(base) == len(head) == len(standard)
    assert standard.split() == ["standard", "25%", "25%", "88%"]


@pytest.mark.parametrize(
    ("gains", "verdict", "success"),
    [
        ([1] * 5, "is clearly above", "+1.00 [+1.00, +1.00]"),
        ([-1] * 5, "is clearly below", "\u22121.00 [\u22121.00, \u22121.00]"),
        ([1, -1, 1, -1, 1], "is not clearly above", "+0.20 ["),
        ([1] * 4, "may be above", "+1.00 [+1.00, +1.00]"),
    ],
)
def test_a_sentence_says_how_sure_a_comparison_is(tmp_path, gains, verdict, success):
    for seed, gain in enumerate(gains):
        for agent, wins in {"standard": gain < 0, "equivariant": gain > 0}.items():
            curve = [make_evaluation([0] * 9, 0, False), make_evaluation([wins] * 9, 10_000)]
            record = make_record(curve, agent=agent, seed=seed, env_steps=10_000)
            write_record(record, tmp_path / f"{record.run_id}.json")
    sentence = " ".join(" ".join(curves_as_text([tmp_path]).splitlines()[4:]).split())
    assert sentence.startswith(f"equivariant {verdict} standard: {success}")
    few = f"base policies: 1; pairs of runs: {len(gains)}, and a verdict needs 5)."
    assert sentence.endswith(few)
