"""PokeCube: stock along +x, the same in all other directions, a peg that is its own half turn."""

import math

import pytest
import torch
from mani_skill.envs.tasks.tabletop.poke_cube import PokeCubeEnv
from mani_skill.utils.structs import Pose

from symsteer.bench.sim.rotations import (
    quaternion_multiply,
    quaternion_to_matrix,
    wrap,
    yaw_quaternion,
)
from symsteer.bench.sim.trees import join_trees, rows_of
from symsteer.bench.tasks.experts import Expert
from tests.bench.shared import shared

COUNT = 24


@pytest.fixture
def env():
    env = shared("PokeCube-v1", COUNT, reward_mode="dense")
    env.reset(seed=list(range(COUNT)))
    return env


def direction(env):
    return quaternion_to_matrix(env.goal_region.pose.q)[:, :2, 2]


def turned(env, angles):
    """The present state with each environment turned by its own angle."""
    state = env.get_state_dict()
    return join_trees(
        [rows_of(env.transform_state(state, float(a)), [i]) for i, a in enumerate(angles)]
    )


def test_the_scene_is_stocks_seen_along_the_direction(env):
    ahead = direction(env)
    side = torch.stack([-ahead[:, 1], ahead[:, 0]], dim=1)
    assert torch.allclose(quaternion_to_matrix(env.peg.pose.q)[:, :2, 0], ahead, atol=1e-6)
    to_cube = (env.cube.pose.p - env.peg.pose.p)[:, :2]
    along, across = (to_cube * ahead).sum(dim=1), (to_cube * side).sum(dim=1)
    assert torch.allclose(along, torch.tensor(env.peg_half_length + 0.1), atol=1e-6)
    assert across.abs().max() <= env.across + 1e-6
    assert across.min() < -0.05
    assert across.max() > 0.05
    to_goal = (env.goal_region.pose.p - env.cube.pose.p)[:, :2]
    assert torch.allclose(to_goal, (0.05 + env.goal_radius) * ahead, atol=1e-6)
    face = quaternion_to_matrix(env.cube.pose.q)[:, :2, 0]
    turn = torch.atan2((face * side).sum(dim=1), (face * ahead).sum(dim=1))
    assert turn.abs().max() <= math.pi / 6 + 1e-6
    assert turn.abs().max() > 0.3


def test_evaluation_and_reward_are_stocks_along_x_and_do_not_turn(env):
    """Over whole episodes of the expert, so that every term of the reward is met."""
    expert = Expert(env)
    terms = {"is_peg_grasped": 0, "is_peg_cube_fit": 0, "is_cube_placed": 0, "success": 0}
    rewards = []
    for step in range(24):
        env.step(expert.act())
        if step % 3:
            continue
        state = env.get_state_dict()
        info = {key: value.clone() for key, value in env.evaluate().items()}
        reward = env.compute_dense_reward(None, None, info).clone()
        rewards.append(reward)
        ahead = direction(env)
        env.set_state_dict(turned(env, -torch.atan2(ahead[:, 1], ahead[:, 0])))
        stock = PokeCubeEnv.evaluate(env)
        assert info.keys() == stock.keys()
        # Contacts are not part of a state: whether the peg is grasped is asked before.
        stock["is_peg_grasped"] = info["is_peg_grasped"]
        agree = torch.ones(COUNT, dtype=torch.bool)
        for key, value in stock.items():
            if value.dtype == torch.bool:
                agree &= info[key] == value
            else:
                # Third Euler angle and yaw differ in second order of how far a peg leans.
                assert torch.allclose(info[key], value, atol=2e-3), (step, key)
        # Rounding may tip a threshold.
        assert agree.sum() >= COUNT - 1, step
        again = env.compute_dense_reward(None, None, stock)
        assert torch.allclose(again[agree], reward[agree], atol=1e-2), step
        for key in terms:
            terms[key] += int(info[key].sum())
        env.set_state_dict(state)
    assert all(terms.values()), terms
    assert torch.cat(rewards).std() > 1


def test_a_half_turned_peg_and_a_quarter_turned_cube_look_the_same(env):
    for _ in range(10):
        env.step(2 * torch.rand(COUNT, 7, generator=torch.Generator().manual_seed(0)) - 1)
    before = env.get_obs().clone()
    close = env.evaluate()["angle_diff"].clone()
    action = Expert(env).act()
    for body, angle in ((env.peg, math.pi), (env.cube, math.pi / 2)):
        turn = yaw_quaternion(torch.full((COUNT,), angle))
        body.set_pose(Pose.create_from_pq(body.pose.p, quaternion_multiply(body.pose.q, turn)))
        assert torch.allclose(env.get_obs(), before, atol=1e-5)
        assert torch.allclose(Expert(env).act(), action, atol=1e-4)
        assert wrap(env.evaluate()["angle_diff"] - close, math.pi / 2).abs().max() < 1e-4


def test_the_nearer_end_is_observed(env):
    ahead = direction(env)
    tip = env.peg.pose.p[:, :2] + env.peg_half_length * ahead
    where = env.observation_layout.slice("peg_end_to_cube_xy")
    assert torch.allclose(env.get_obs()[:, where], env.cube.pose.p[:, :2] - tip, atol=1e-5)
