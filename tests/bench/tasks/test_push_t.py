"""PushT: the goal is part of the state, and success turns with it."""

import math

import pytest
import torch
from mani_skill.envs.tasks.tabletop.push_t import PushTEnv
from mani_skill.utils.structs import Pose

from symsteer.bench.sim.parallel import create
from symsteer.bench.sim.rotations import quaternion_to_matrix, yaw_quaternion
from symsteer.policies.geometry import Group
from tests.bench.shared import shared

COUNT = 48
PIXELS = 825
"""Of a whole T in ManiSkill's drawing."""


@pytest.fixture
def env():
    env = shared("PushT-v1", COUNT, reward_mode="dense")
    env.reset(seed=list(range(COUNT)))
    return env


def uniform(low, high, seed):
    return low + (high - low) * torch.rand(COUNT, generator=torch.Generator().manual_seed(seed))


def flat(x, y, yaw, z=0.02):
    return Pose.create_from_pq(torch.stack([x, y, torch.full_like(x, z)], 1), yaw_quaternion(yaw))


def test_yaw_of_any_quaternion(env):
    yaw = torch.linspace(0.01, 2 * math.pi - 0.01, 200)
    q = yaw_quaternion(yaw)
    for sign in (1, -1):
        assert torch.allclose(env.quat_to_z_euler(sign * q), yaw, atol=1e-5)
    rounded = torch.tensor([[1.0000001, 0.0, 0.0, 1e-4]])
    assert torch.allclose(env.quat_to_z_euler(rounded), torch.tensor([2e-4]), atol=1e-6)
    assert PushTEnv.quat_to_z_euler(env, rounded).isnan().all()  # why it is replaced


def test_overlap_is_the_mean_of_stocks_for_both_mirror_images(env):
    stock = create(PushTEnv, num_envs=COUNT)
    stock.reset(seed=0)
    dx, dy, turn = uniform(-0.02, 0.02, 3), uniform(-0.02, 0.02, 4), uniform(-0.3, 0.3, 5)

    def on_goal(x, y, yaw, dx, dy, turn):
        cos, sin = torch.cos(yaw), torch.sin(yaw)
        return flat(x + cos * dx - sin * dy, y + sin * dx + cos * dy, yaw + turn)

    def stock_overlap(*offset):
        goal = (*stock.goal_offset[:2], stock.goal_z_rot)
        stock.tee.set_pose(on_goal(*(torch.full((COUNT,), float(g)) for g in goal), *offset))
        return stock.pseudo_render_intersection()

    expected = (stock_overlap(dx, dy, turn) + stock_overlap(-dx, dy, -turn)) / 2
    goal = (uniform(-0.05, 0.05, 6), uniform(-0.05, 0.05, 7), uniform(-3, 3, 8))
    env.goal_tee.set_pose(flat(*goal, z=1e-3))
    env.tee.set_pose(on_goal(*goal, dx, dy, turn))
    # A point on the edge of a pixel may be rounded to either side.
    assert torch.allclose(env.pseudo_render_intersection(), expected, atol=3 / PIXELS)
    assert expected.std() > 0.02
    stock.close()


def test_success_turns_with_block_and_goal(env):
    goal = env.goal_tee.pose  # blocks up to 1 cm and 0.1 rad off their goals
    yaw = 2 * torch.atan2(goal.q[:, 3], goal.q[:, 0])
    x, y = (goal.p[:, i] + uniform(-0.01, 0.01, i) for i in range(2))
    env.tee.set_pose(flat(x, y, yaw + uniform(-0.1, 0.1, 2)))
    state = env.get_state_dict()
    share, won = env.pseudo_render_intersection(), env.evaluate()["success"]
    assert 5 < won.sum() < COUNT - 5
    clear = (share - env.intersection_thresh).abs() > 3 / PIXELS
    assert clear.sum() > COUNT / 2
    for angle, reflect in [*Group.parse("D8").elements, (0.3, False), (-2.0, True)]:
        env.set_state_dict(env.transform_state(state, angle, reflect))
        turned = env.pseudo_render_intersection()
        assert torch.allclose(turned, share, atol=3 / PIXELS), (angle, reflect)
        assert torch.equal(env.evaluate()["success"][clear], won[clear])


def test_goal_is_where_its_actor_is(env):
    """Stock's constants play no part: block on goal succeeds anywhere, goal moved away fails."""
    goal = env.goal_tee.pose
    stem = quaternion_to_matrix(goal.q)[:, :, 1]
    p = goal.p + env.drawing_offset * stem
    env.tee.set_pose(Pose.create_from_pq(p, goal.q))
    assert env.evaluate()["success"].all()
    env.goal_tee.set_pose(Pose.create_from_pq(goal.p + torch.tensor([0.03, 0.0, 0.0]), goal.q))
    assert not env.evaluate()["success"].any()


def test_reward_at_stocks_goal_is_stocks(env):
    at = torch.ones(COUNT)
    env.goal_tee.set_pose(
        flat(env.goal_offset[0] * at, env.goal_offset[1] * at, env.goal_z_rot * at, z=1e-3)
    )
    info = env.evaluate()
    ours = env.compute_dense_reward(None, None, info)
    stock = PushTEnv.compute_dense_reward(env, None, None, info)
    assert torch.allclose(ours, stock, atol=1e-5)
    assert ours.std() > 0.05


def test_a_mirrored_block_covers_the_mirrored_points(env):
    # Ends of the bar and of the stem: the T is their mirror image only across its y-z plane.
    marks = torch.tensor([[-0.1, -0.0375, 0.0], [0.1, -0.0375, 0.0], [0.0, 0.1375, 0.0]])

    def points(actor):
        return actor.pose.p[:, None] + marks @ quaternion_to_matrix(actor.pose.q).mT

    state = env.get_state_dict()
    before = [points(actor) for actor in (env.tee, env.goal_tee)]
    env.set_state_dict(env.transform_state(state, 0.0, True))
    for actor, old in zip((env.tee, env.goal_tee), before, strict=True):
        mirrored = old * torch.tensor([1.0, -1.0, 1.0])
        # The ends of the bar change places.
        assert torch.allclose(points(actor), mirrored[:, [1, 0, 2]], atol=1e-6)


def test_resets(env):
    obs, layout = env.get_obs(), env.observation_layout
    assert obs[:, layout.slice("goal_xy")].norm(dim=1).max() <= env.goal_spawn_radius + 1e-6
    turn = torch.atan2(obs[:, layout.slice("turn_sin")], obs[:, layout.slice("turn_cos")])
    assert 0.8 * env.max_turn < turn.abs().max() <= env.max_turn + 1e-5
    assert env.evaluate()["success"].float().mean() < 0.05
