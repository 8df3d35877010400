"""The floating gripper's controller: follows, is bounded by norms, commutes with symmetries."""

import math

import pytest
import torch
from mani_skill.agents.robots import Panda
from scipy.spatial.transform import Rotation

from symsteer.bench.sim.rotations import (
    euler_rates_matrix,
    euler_to_matrix,
    matrix_to_euler_facing_down,
    planar_matrix,
    quaternion_to_matrix,
    rotation_vector_to_matrix,
    transform_quaternion,
)
from symsteer.bench.tasks.experts import Expert
from symsteer.bench.tasks.floating import ACTION_LAYOUT, PlanarPoseControllerConfig, bound_blocks
from symsteer.policies.geometry import Group
from tests.bench.shared import shared


@pytest.fixture
def env():
    env = shared("PickCube-v1", 16)
    env.reset(seed=list(range(16)))
    return env


def test_bound_blocks_shortens_norms_and_is_idempotent():
    action = 3 * torch.randn(1000, 7, generator=torch.Generator().manual_seed(0))
    bounded = bound_blocks(action, ACTION_LAYOUT)
    for block in ACTION_LAYOUT.blocks:
        norm = action[:, block].norm(dim=1)
        assert torch.allclose(bounded[:, block].norm(dim=1), norm.clamp(max=1), atol=1e-6)
    assert torch.equal(bound_blocks(bounded, ACTION_LAYOUT), bounded)
    for angle, reflect in Group.parse("D8").elements:
        turned = bound_blocks(ACTION_LAYOUT.transform(action, angle, reflect), ACTION_LAYOUT)
        expected = ACTION_LAYOUT.transform(bounded, angle, reflect)
        assert torch.allclose(turned, expected, atol=1e-5)


@pytest.mark.parametrize("embodiment", ["floating", "panda"])
def test_a_grasp_is_what_maniskill_calls_one(embodiment):
    env = shared("PickCube-v1", 8, embodiment=embodiment)
    env.reset(seed=list(range(8)))
    expert, stock = Expert(env), Panda.is_grasping.__wrapped__
    noise, shares = torch.Generator().manual_seed(0), []
    for _ in range(25):
        env.step(expert.act(0.3 * torch.randn(8, 7, generator=noise)))
        for limits in ((0.5, 85), (2.0, 85), (0.5, 5)):
            found = env.agent.is_grasping(env.cube, *limits)
            assert torch.equal(found, stock(env.agent, env.cube, *limits))
            shares.append(found.float().mean())
    assert 0.1 < sum(shares) / len(shares) < 0.9


@pytest.mark.parametrize("name", ["xy", "vertical", "tilt", "yaw"])
def test_the_controller_follows(env, name):
    """Three steps at norm 1 cover at least 90 % of three step lengths, and never more."""
    config = PlanarPoseControllerConfig
    step = getattr(config, f"{'horizontal' if name == 'xy' else name}_step")
    before = env.agent.tcp_pose.raw_pose.clone()
    action = torch.zeros(16, 7)
    bearing = torch.arange(16) * (2 * math.pi / 16)
    block = ACTION_LAYOUT.slice("z" if name == "vertical" else name)
    if block.stop - block.start == 2:
        action[:, block] = 5 * torch.stack([bearing.cos(), bearing.sin()], dim=1)
    else:
        action[:, block] = 5.0
    for _ in range(3):
        env.step(action)
    after = env.agent.tcp_pose.raw_pose
    distance = moved = (after[:, :3] - before[:, :3]).norm(dim=1)
    if name in ("tilt", "yaw"):
        turn = quaternion_to_matrix(after[:, 3:]) @ quaternion_to_matrix(before[:, 3:]).mT
        distance = torch.acos(((turn.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2).clamp(-1, 1))
        assert moved.max() < 3e-3
        assert name == "tilt" or (turn[:, 1, 0] > 0.1).all(), "positive is counter-clockwise"
    assert (distance / (3 * step)).min() > 0.9
    assert (distance / (3 * step)).max() < 1.02
    assert (distance.max() - distance.min()) / step < 0.01


def test_a_blocked_gripper_does_not_wind_up(env):
    down = torch.zeros(16, 7)
    down[:, ACTION_LAYOUT.slice("z")] = -1.0
    for _ in range(15):
        env.step(down)
    up = -down
    height = env.agent.tcp_pose.p[:, 2].clone()
    env.step(up)
    assert (env.agent.tcp_pose.p[:, 2] - height).min() > 0.005


def test_tilt_and_reach_are_limited(env):
    action = torch.zeros(16, 7)
    action[:, ACTION_LAYOUT.slice("tilt")] = torch.tensor([0.6, 0.8])
    action[:, ACTION_LAYOUT.slice("xy")] = torch.tensor([0.6, -0.8])
    action[:, ACTION_LAYOUT.slice("z")] = 0.3
    for _ in range(25):
        env.step(action)
    tool = quaternion_to_matrix(env.agent.tcp_pose.q)[:, :, 2]
    lean = torch.acos(-tool[:, 2])
    config = PlanarPoseControllerConfig
    assert torch.allclose(lean, torch.tensor(config.max_tilt), atol=0.02)
    radius = env.agent.tcp_pose.p[:, :2].norm(dim=1)
    assert torch.allclose(radius, torch.tensor(config.reach), atol=0.01)


def test_is_static_ignores_direction(env):
    state = env.get_state_dict()
    bearing = torch.arange(16) * (2 * math.pi / 16)
    for speed, expected in ((0.19, True), (0.21, False)):
        robot = state["articulations"][env.agent.robot.name]
        robot[:, 21] = speed * bearing.cos()
        robot[:, 22] = speed * bearing.sin()
        env.set_state_dict(state)
        assert env.agent.is_static(0.2).tolist() == [expected] * 16


def test_conversions_are_scipys():
    generator = torch.Generator().manual_seed(0)
    angles = torch.rand(200, 3, generator=generator, dtype=torch.float64) - 0.5
    angles[:, 1] += math.pi
    angles[:, 2] *= 20
    matrix = euler_to_matrix(angles)
    expected = torch.tensor(Rotation.from_euler("XYZ", angles.numpy()).as_matrix())
    assert torch.allclose(matrix, expected, atol=1e-12)
    assert torch.allclose(matrix_to_euler_facing_down(matrix, angles + 0.5), angles, atol=1e-9)
    vectors = torch.cat([torch.zeros(1, 3), angles])
    expected = torch.tensor(Rotation.from_rotvec(vectors.numpy()).as_matrix())
    assert torch.allclose(rotation_vector_to_matrix(vectors), expected, atol=1e-12)


def test_euler_rates_give_the_angular_velocity():
    generator = torch.Generator().manual_seed(0)
    angles, rates = torch.randn(2, 100, 3, generator=generator, dtype=torch.float64)
    step = euler_to_matrix(angles + 1e-6 * rates) @ euler_to_matrix(angles - 1e-6 * rates).mT
    skew = (step - step.mT) / 4e-6
    omega = torch.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], dim=1)
    computed = (euler_rates_matrix(angles) @ rates[:, :, None])[..., 0]
    assert torch.allclose(computed, omega, atol=1e-7)


@pytest.mark.parametrize("element", [(0.7, False), (0.7, True), (0.0, True)])
def test_mirrored_orientations_are_conjugated(element):
    q = torch.tensor(Rotation.random(50, random_state=0).as_quat())
    turn = planar_matrix(element[0], False, q)
    mirror = planar_matrix(0.0, element[1], q)
    expected = turn @ mirror @ quaternion_to_matrix(q) @ mirror
    computed = quaternion_to_matrix(transform_quaternion(q, *element))
    assert torch.allclose(computed, expected, atol=1e-12)
