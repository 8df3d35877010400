"""LiftPegUpright: success does not know the world's axes, the peg is its own half turn."""

import math

import pytest
import torch
from mani_skill.envs.tasks.tabletop.lift_peg_upright import LiftPegUprightEnv
from mani_skill.utils.structs import Pose

from symsteer.bench.sim.rotations import quaternion_multiply, yaw_quaternion
from symsteer.bench.tasks.embodiments import BODIES
from symsteer.policies.geometry import Group
from tests.bench.shared import shared

COUNT = 64


@pytest.fixture
def env():
    env = shared("LiftPegUpright-v1", COUNT)
    env.reset(seed=list(range(COUNT)))
    return env


def about(axis, angle):
    """Quaternions ``[N, 4]`` of turns by ``angle [N]`` about the x, y or z axis."""
    q = torch.zeros(len(angle), 4)
    q[:, 0] = torch.cos(angle / 2)
    q[:, 1 + "xyz".index(axis)] = torch.sin(angle / 2)
    return q


def uniform(low, high, seed):
    return low + (high - low) * torch.rand(COUNT, generator=torch.Generator().manual_seed(seed))


def place(env, q, height):
    p = torch.zeros(COUNT, 3)
    p[:, 2] = height
    env.peg.set_pose(Pose.create_from_pq(p, q))


def near_upright():
    """Orientations up to 0.16 rad from upright, either end up, in all bearings, any roll."""
    lean = about("y", -math.pi / 2 + uniform(-0.16, 0.16, 0))
    q = quaternion_multiply(lean, about("x", uniform(-math.pi, math.pi, 1)))
    other_end = (torch.arange(COUNT) % 2).float() * math.pi
    q = quaternion_multiply(q, about("z", other_end))
    return quaternion_multiply(yaw_quaternion(uniform(-math.pi, math.pi, 2)), q)


def test_success_is_invariant_and_stocks_is_not(env):
    place(env, near_upright(), uniform(0.114, 0.126, 5))
    state = env.get_state_dict()
    ours, stock = env.evaluate()["success"], LiftPegUprightEnv.evaluate(env)["success"]
    assert 10 < ours.sum() < COUNT - 10
    stock_changed = False
    for angle, reflect in [*Group.parse("D8").elements, (0.3, False), (-2.0, True)]:
        env.set_state_dict(env.transform_state(state, angle, reflect))
        assert torch.equal(env.evaluate()["success"], ours), (angle, reflect)
        stock_changed |= not torch.equal(LiftPegUprightEnv.evaluate(env)["success"], stock)
    assert stock_changed
    # A peg that leans in the x-z plane about its body z axis: stock's Euler angle is its tilt.
    lean = about("y", -math.pi / 2 + uniform(-0.2, 0.2, 3))
    lean = quaternion_multiply(lean, about("x", torch.full((COUNT,), 1.5708)))
    place(env, lean, uniform(0.112, 0.128, 4))
    assert torch.equal(env.evaluate()["success"], LiftPegUprightEnv.evaluate(env)["success"])


@pytest.mark.parametrize(
    ("tilt", "height", "success"),
    [
        (0.0, 0.12, True),
        (0.079, 0.12, True),
        (0.081, 0.12, False),
        (math.pi / 2, 0.12, False),  # lying in the air, which stock may call upright
        (0.0, 0.1249, True),
        (0.0, 0.1251, False),
        (0.0, 0.1149, False),
    ],
)
def test_tolerances(env, tilt, height, success):
    bearing = yaw_quaternion(torch.arange(COUNT) * (2 * math.pi / COUNT))
    lean = about("y", torch.full((COUNT,), -math.pi / 2 + tilt))
    place(env, quaternion_multiply(bearing, lean), height)
    assert env.evaluate()["success"].tolist() == [success] * COUNT


def test_all_ways_to_name_the_pegs_axes_are_observed_alike(env):
    place(env, near_upright(), 0.13)
    seen = env.get_obs().clone()
    q = env.peg.pose.q.clone()
    for axis, turn in [("x", math.pi / 2), ("x", math.pi), ("y", math.pi), ("z", math.pi)]:
        place(env, quaternion_multiply(q, about(axis, torch.full((COUNT,), turn))), 0.13)
        assert torch.allclose(env.get_obs(), seen, atol=2e-6), axis


def test_the_pandas_wrist_takes_the_turn_that_its_joint_allows():
    panda, floating = BODIES["panda"], BODIES["floating"]
    qpos = torch.zeros(4, 9)
    qpos[:, 6] = torch.tensor([0.0, 2.0, 2.0, -2.0])
    turn = torch.tensor([1.5, 1.5, -1.5, 1.5])
    none = torch.zeros(4)
    # Turning the tool by +1 rad turns joint 7, whose stops are at 2.9 rad, by -1 rad.
    other = math.pi - 1.5
    expected = torch.tensor([1.5, 1.5, other, -other])
    assert torch.allclose(panda.reachable_turn(qpos, turn, none), expected)
    assert torch.equal(floating.reachable_turn(qpos, turn, none), turn)
    # A load that is to be turned by 1.5 rad afterwards in the same sense leaves less room.
    later = torch.full((4,), 1.5)
    expected = torch.tensor([-other, 1.5, other, -other])
    assert torch.allclose(panda.reachable_turn(qpos, turn, later), expected)
