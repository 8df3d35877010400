"""The table of what a test of decisions finds."""

import pytest

from symsteer.errors import UserError
from tests.leaderboard.record_factory import make_evaluation, make_record
from tools.pages.sides import render


def record(seed, direction, drift, **config):
    found = {"direction_p": direction, "axis_p": 0.5, "drift_x": drift, "drift_y": 0.0}
    return make_record([make_evaluation([1, 0], **found)], agent="base", seed=seed, **config)


def test_shares_of_runs_and_the_mean_size_of_the_drift():
    runs = [record(0, 0.001, 0.01), record(1, 0.01, -0.03), record(2, 0.02, 0.02)]
    longer = record(0, 0.001, 0.01, env_steps=500_000)  # the same episodes
    (row,) = render([*runs, longer]).splitlines()[2:]
    assert [cell.strip() for cell in row.split("|")[2:-1]] == [
        *("`none`", "1", "3", "0.67", "0.00", "2.00")
    ]


def test_runs_of_learners_have_no_such_test():
    learner = make_record([make_evaluation([1, 0])], agent="standard")
    with pytest.raises(UserError, match="no finished run of base has the test of sides"):
        render([learner])
