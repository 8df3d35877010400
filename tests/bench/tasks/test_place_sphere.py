"""PlaceSphere: a square bin, a sphere without orientation, and a placement to 5 mm."""

import math

import pytest
import torch
from mani_skill.utils.structs import Pose

from symsteer.bench.sim.rotations import quaternion_multiply, yaw_quaternion
from symsteer.bench.tasks.experts import Expert
from tests.bench.shared import shared


@pytest.fixture
def env():
    env = shared("PlaceSphere-v1", 32)
    env.reset(seed=list(range(32)))
    return env


def test_resets_leave_room_for_the_fingers(env):
    gap = (env.obj.pose.p - env.bin.pose.p)[:, :2].norm(dim=1)
    low, high = env.distance_range
    assert (gap >= low - 1e-6).all()
    assert (gap <= high + 1e-6).all()
    # Half a diagonal of the bin, a sphere, a finger on the far side of it.
    assert low > math.sqrt(2) * env.block_half_size[1] + 2 * env.radius + 0.03
    assert torch.allclose(env.obj.pose.p[:, 2], torch.tensor(env.radius))


def test_quarter_turns_of_the_bin_and_turns_of_the_sphere_are_not_seen(env):
    before = env.get_obs().clone()
    quarter = yaw_quaternion(torch.full((32,), math.pi / 2))
    place = env.bin.pose
    env.bin.set_pose(Pose.create_from_pq(place.p, quaternion_multiply(place.q, quarter)))
    env.obj.set_pose(Pose.create_from_pq(env.obj.pose.p, torch.tensor([[0.5, 0.5, -0.5, 0.5]])))
    assert torch.allclose(env.get_obs(), before, atol=1e-6)
    eighth = yaw_quaternion(torch.full((32,), math.pi / 4))
    env.bin.set_pose(Pose.create_from_pq(place.p, quaternion_multiply(place.q, eighth)))
    yaw = env.observation_layout.slice("bin_yaw")
    assert torch.allclose(env.get_obs()[:, yaw], -before[:, yaw], atol=1e-6)


def test_the_expert_lets_go_of_a_sphere_that_stays(env):
    env.reset(seed=list(range(100, 132)))
    expert = Expert(env)
    for _ in range(40):
        info = env.step(expert.act())[-1]
    assert info["success"].float().mean() >= 0.95
    done = info["success"]
    offset = (env.obj.pose.p - env.bin.pose.p)[done]
    # Walls, 2 cm from the middle and 15 mm high, leave a sphere on the floor less than 3 mm.
    assert (offset[:, :2].norm(dim=1) < 0.004).all()
    assert ((offset[:, 2] - env.radius - env.block_half_size[0]).abs() < 1e-3).all()
    assert (env.agent.tcp_pose.p[done, 2] > 0.1).all()
