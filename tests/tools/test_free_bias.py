"""The table of what free biases say of a displaced camera."""

import pytest

from symsteer.errors import UserError
from symsteer.leaderboard.text import MINUS, SPACE
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
    title, table = render(runs).replace(SPACE, " ").replace(MINUS, "-").split("\n\n")
    assert title == "`PickCube-v1`, 8 runs:"
    rows = [[cell.strip() for cell in row.split("|")[1:-1]] for row in table.splitlines()[2:]]
    assert [row[:4] for row in rows[:4]] == [
        ["`none`", "0 cm", "11.00 (1.41)", "-11.00 (1.41)"],
        ["`perception_bias:0.5`", "1 cm", "21.00 (1.41)", "-21.00 (1.41)"],
        ["`perception_bias:1`", "2 cm", "31.00 (1.41)", "-31.00 (1.41)"],
        ["`action_gain:1`", "", "51.00 (1.41)", "-51.00 (1.41)"],
    ]
    assert rows[0][-1] == "0.11 (0.01)"
    assert rows[4][:2] == ["rank correlation", ""]
    assert [float(cell) for cell in rows[4][2:4]] == pytest.approx([0.96, -0.96], abs=0.01)


def test_other_runs_are_refused():
    for other in (
        make_record([make_evaluation([1])]),
        make_record([make_evaluation([1])], agent="free-bias"),
    ):
        with pytest.raises(UserError, match="no run of free-bias that has its shifts"):
            render([other])
    with pytest.raises(UserError, match="no finished run"):
        render([])
