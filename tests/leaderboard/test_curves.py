import math

import pytest

from symsteer.leaderboard.curves import direction_curve
from symsteer.leaderboard.records import write_record
from symsteer.leaderboard.summary import load_runs, summarize
from tests.leaderboard.record_factory import make_evaluation, make_record


def row_of(tmp_path, *runs):
    """The row of runs that are given as successes and directions in degrees."""
    for seed, (successes, degrees) in enumerate(runs):
        evaluation = make_evaluation(successes)
        if degrees is not None:
            radians = [None if d is None else math.radians(d) for d in degrees]
            evaluation.episodes.direction = radians
        record = make_record([evaluation], agent="base", seed=seed)
        write_record(record, tmp_path / str(seed) / "record.json")
    (table,) = summarize(load_runs([tmp_path])).tables
    (row,) = (row for row in table.rows if row.runs)
    return row


def test_successes_are_counted_in_sectors(tmp_path):
    curve = direction_curve(row_of(tmp_path, ([1, 0, 1, 1, 0], [0, 20, 30, 179, -179])))
    assert curve.steps == [-180, 0, 45, 180]
    assert curve.values == pytest.approx([0.5, 0.5, 1, 0.5])
    assert all(a <= b <= c for a, b, c in zip(curve.low, curve.values, curve.high, strict=True))
    # Wilson's interval of one success.
    assert curve.low[2] < 0.3 < curve.high[2] == 1


def test_each_run_counts_once(tmp_path):
    curve = direction_curve(row_of(tmp_path, ([1, 1, 1], [90, 90, 91]), ([0], [90])))
    assert (curve.steps, curve.values) == ([90], [0.5])


def test_episodes_and_runs_without_a_direction_do_not_count(tmp_path):
    row = row_of(tmp_path, ([1, 0, 1], [90, None, 91]), ([0], None))
    assert direction_curve(row).values == [1]


def test_records_without_directions_give_no_curve(tmp_path):
    assert direction_curve(row_of(tmp_path, ([1, 0], None))) is None
