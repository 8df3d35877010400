"""The table of what free biases say of a displaced camera."""

import pytest

from symsteer.errors import UserError
from tests.leaderboard.record_factory import make_evaluation, make_record
from tools.pages.free_bias import MEASURES, render


def record(variant, size, seed, **config):
    diagnostics = dict(zip(MEASURES, (size, 2 * size, -size), strict=True))
    evaluation = make_evaluation([1, 0], **diagnostics)
    return make_record([evaluation], variant=variant, seed=seed, agent="free-bias", **config)


def test_rows_are_ordered_by_the_displacement_and_end_with_rank_correlations():
    sizes = {"perception_bias:1": 0.3, "none": 0.1, "perception_bias:0.5": 0.2}
    runs = [record(v, size + 0.02 * seed, seed) for v, size in sizes.items() for seed in (0, 1)]
    rows = [[cell.strip() for cell in row.split("|")[2:-1]] for row in render(runs).splitlines()]
    assert rows[2:5] == [
        ["0 cm", "2", "0.110 (0.014)", "0.220 (0.028)", "-0.110 (0.014)"],
        ["1 cm", "2", "0.210 (0.014)", "0.420 (0.028)", "-0.210 (0.014)"],
        ["2 cm", "2", "0.310 (0.014)", "0.620 (0.028)", "-0.310 (0.014)"],
    ]
    assert rows[5][0] == "rank correlation"
    assert [float(cell) for cell in rows[5][2:]] == pytest.approx([0.96, 0.96, -0.96], abs=0.01)


def test_runs_of_other_agents_are_no_runs_of_free_bias():
    with pytest.raises(UserError, match="no run of free-bias"):
        render([make_record([make_evaluation([1])])])
    with pytest.raises(UserError, match="no finished run"):
        render([])
