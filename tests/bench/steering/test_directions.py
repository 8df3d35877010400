import math

import pytest
import torch

from symsteer.bench.steering.directions import directions, positions
from symsteer.bench.tasks import task_class
from symsteer.policies.geometry import Field, Layout
from tests.bench.shared import STATE_TASKS

LAYOUT = Layout(
    [
        Field("height", 0),
        Field("tcp_xy", 1),
        Field("cube_xy", 1),
        Field("tcp_to_cube_xy", 1),
        Field("goal_xy", 1),
    ]
)


@pytest.mark.parametrize("task", STATE_TASKS)
def test_every_task_names_a_tool_and_something_to_move(task):
    names = positions(task_class(task).observation_layout)
    assert names[0] == "tcp_xy"
    assert len(names) >= 2
    assert not any("axis" in name or "normal" in name for name in names)


def test_the_direction_is_that_from_the_object_to_its_goal():
    obs = torch.tensor([[9.0, 5, 5, 1, 1, 7, 7, 1, 3], [9.0, 5, 5, 1, 1, 7, 7, -1, 1]])
    assert directions(obs, LAYOUT).tolist() == pytest.approx([math.pi / 2, math.pi])


def test_directions_turn_with_the_world():
    obs = torch.randn(20, LAYOUT.dim, dtype=torch.float64)
    turned = directions(LAYOUT.transform(obs, 0.7), LAYOUT) - directions(obs, LAYOUT)
    assert torch.allclose(torch.remainder(turned, 2 * math.pi), torch.tensor(0.7).double())


def test_a_layout_with_one_position_has_no_directions():
    assert directions(torch.zeros(3, 2), Layout([Field("tcp_xy", 1)])) is None
