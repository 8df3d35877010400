"""The table of what free biases say of a displaced camera."""

import pytest

from symsteer.errors import UserError
from tests.leaderboard.record_factory import make_evaluation, make_record
from tools.pages.free_bias import MEASURES, render


def record(variant, size, seed, **config):
    diagnostics = dict.fromkeys(MEASURES, size) | {"displacement_y": -size}
    evaluation = make_evaluation([1, 0], **diagnostics)
    return make_record([evaluation], variant=variant, seed=seed, agent="free-bias", **config)


def test_rows_are_ordered_by_the_displacement_and_end_with_rank_correlations():
    sizes = {
        "action_gain:1": 0.5,
        "perception_bias:1": 0.3,
        "none": 0.1,
        "perception_bias:0.5": 0.2,
    }
    runs = [record(v, size + 0.02 * seed, seed) for v, size in sizes.items() for seed in (0, 1)]
    rows = [[cell.strip() for cell in row.split("|")[2:-1]] for row in render(runs).splitlines()]
    assert [row[:5] for row in rows[2:6]] == [
        ["`none`", "0 cm", "2", "11.00 (1.41)", "-11.00 (1.41)"],
        ["`perception_bias:0.5`", "1 cm", "2", "21.00 (1.41)", "-21.00 (1.41)"],
        ["`perception_bias:1`", "2 cm", "2", "31.00 (1.41)", "-31.00 (1.41)"],
        ["`action_gain:1`", "", "2", "51.00 (1.41)", "-51.00 (1.41)"],
    ]
    assert rows[2][-1] == "0.110 (0.014)"
    assert rows[6][:3] == ["rank correlation", "", "6"]
    assert [float(cell) for cell in rows[6][3:5]] == pytest.approx([0.96, -0.96], abs=0.01)


def test_other_runs_are_refused():
    for other in (
        make_record([make_evaluation([1])]),
        make_record([make_evaluation([1])], agent="free-bias"),
    ):
        with pytest.raises(UserError, match="no run of free-bias that has its shifts"):
            render([other])
    with pytest.raises(UserError, match="no finished run"):
        render([])
