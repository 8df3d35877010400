"""Variants of what is commanded, observed, paid, and where episodes begin."""

import math

import pytest
import torch

from symsteer.bench.audit.states import Turner
from symsteer.bench.steering.latent_env import LatentNoiseEnv
from symsteer.bench.tasks import make, task_class
from symsteer.policies.geometry import Group
from tests.bench.shared import shared
from tests.bench.steering.test_latent_env import NoiseIsAction
from tests.bench.variants.scenes import act, fields, scene

STRENGTHS = torch.tensor([0.0, 0.5, 1.0])
SEEDS = [4, 4, 4]


def alike(variant, strength=STRENGTHS, **options):
    """Environments that start alike and differ in strength; and what they show at first."""
    env = scene(variant, strength, **options)
    obs, _ = env.reset(seed=[4] * env.num_envs)
    return env, fields(env, obs.clone())


# ----------------------------------------------------------------------- actuation


def test_action_gain_scales_one_axis():
    env = scene("action_gain", STRENGTHS)
    for axis, gains in ((0, 1 - 0.6 * STRENGTHS), (1, torch.ones(3))):
        env.reset(seed=SEEDS)
        before = env.agent.tcp_pose.p.clone()
        # Far beyond the bound: commanding more does not make up for the gain.
        xy = (10.0, 0.0) if axis == 0 else (0.0, 10.0)
        for _ in range(3):
            env.step(act(env, xy=xy))
        env.step(act(env))
        moved = (env.agent.tcp_pose.p - before)[:, axis]
        assert torch.allclose(moved, 0.09 * gains, atol=2e-3)


def test_actuator_offset_is_the_same_for_every_action():
    """9 mm a step along +x at strength 1, also beside a full step in any direction."""
    env = scene("actuator_offset", STRENGTHS)
    for xy in ((0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0)):
        env.reset(seed=SEEDS)
        before = env.agent.tcp_pose.p.clone()
        for _ in range(5):
            env.step(act(env, xy=xy))
        moved = env.agent.tcp_pose.p - before
        expected = torch.zeros(3, 3)
        expected[:, 0] = 5 * 0.009 * STRENGTHS
        # The hand trails its target by up to a tenth of a step.
        assert torch.allclose(moved - moved[:1], expected, atol=2e-3)


def test_actuator_offset_of_the_arm():
    env = scene("actuator_offset", STRENGTHS, embodiment="panda")
    for xy in ((0.0, 0.0), (1.0, 0.0)):
        env.reset(seed=SEEDS)
        before = env.agent.tcp_pose.p.clone()
        for _ in range(4):
            env.step(act(env, xy=xy))
        drift = (env.agent.tcp_pose.p - before)[:, 0]
        drift = ((drift - drift[0]) / 4).tolist()
        assert 0.008 < drift[2] < 0.016
        assert drift[1] == pytest.approx(drift[2] / 2, rel=0.2)


# ----------------------------------------------------------------------- observation


def test_perception_bias_shifts_the_objects_fields_by_a_vector():
    _, seen = alike("perception_bias")
    bias = torch.stack([0.02 * STRENGTHS, torch.zeros(3)], dim=1)
    signs = {"cube_xy": 1, "tcp_to_cube_xy": 1, "cube_to_goal_xy": -1}
    for name, value in seen.items():
        if name in signs:
            assert torch.allclose(value - value[:1], signs[name] * bias, atol=1e-7), name
        else:
            assert torch.equal(value, value[:1].expand_as(value)), name


def test_frame_offset_shifts_what_is_absolute():
    env, seen = alike("frame_offset")
    shift = torch.stack([0.05 * STRENGTHS, torch.zeros(3)], dim=1)
    assert torch.equal(env.policy_origin, shift)
    for name, value in seen.items():
        if name in ("tcp_xy", "cube_xy", "goal_xy"):
            assert torch.allclose(value[:1] - value, shift, atol=1e-7), name
        else:
            assert torch.allclose(value, value[:1].expand_as(value), atol=1e-7), name


def test_frame_offset_keeps_the_symmetry_about_the_policys_origin():
    env = scene("frame_offset:1")
    state, obs = env.get_state_dict(), env.get_obs().clone()
    for element in Group.parse("D4").elements:
        turned, _ = Turner(env).turn(state, element, env.policy_origin[0])
        env.set_state_dict(turned)
        expected = env.observation_layout.transform(obs, *element)
        assert torch.allclose(env.get_obs(), expected, atol=2e-6)
    about_centre = env.transform_state(state, math.pi / 2)
    env.set_state_dict(about_centre)
    gap = env.get_obs() - env.observation_layout.transform(obs, math.pi / 2)
    assert gap.abs().max() > 0.04


def test_frame_rotation_turns_the_observation():
    env, seen = alike("frame_rotation")
    layout = env.observation_layout
    flat = torch.cat(list(seen.values()), dim=1)
    for row, strength in enumerate(STRENGTHS.tolist()):
        expected = layout.transform(flat[:1], math.radians(45) * strength)[0]
        assert torch.allclose(flat[row], expected, atol=1e-6)
    assert not torch.allclose(flat[0], flat[2], atol=1e-2)


def test_frame_rotation_commutes_with_rotations_and_not_with_reflections():
    env = scene("frame_rotation:1")
    state, obs = env.get_state_dict(), env.get_obs().clone()
    for angle, reflect in Group.parse("D8").elements:
        env.set_state_dict(env.transform_state(state, angle, reflect))
        expected = env.observation_layout.transform(obs, angle, reflect)
        gap = (env.get_obs() - expected).abs().max()
        assert gap > 0.05 if reflect else gap < 1e-5, (angle, reflect, gap)


def test_noise_is_that_of_the_episode_and_the_step():
    env, _ = alike("observation_noise")
    reference, alone = scene(num_envs=3), scene("observation_noise", torch.tensor([1.0]))
    reference.reset(seed=SEEDS)
    alone.reset(seed=[4])
    for _ in range(2):
        action = act(env, xy=(0.5, 0.5))
        obs, truth = env.step(action)[0].clone(), fields(env, reference.step(action)[0])
        assert torch.equal(env.get_obs(), obs), "asked twice"
        for name, value in fields(env, obs).items():
            noise = value - truth[name]
            if name in ("cube_xy", "tcp_to_cube_xy"):
                # One draw, scaled by the strength.
                assert torch.allclose(noise[1], noise[2] / 2, atol=1e-6)
                assert noise[2].abs().max() > 1e-4
            elif name != "cube_to_goal_xy":
                assert not noise.any(), name
        single = alone.step(action[:1])[0]
    assert torch.equal(single[0], obs[2]), "the number of environments plays a part"


def test_noise_is_fresh_in_every_step_and_episode_and_larger_along_x():
    count, draws = 64, []
    env = scene("observation_noise:1", num_envs=count)
    for seeds in (list(range(count)), None, None, list(range(count))):
        # Without seeds ManiSkill keeps an environment's seed; the noise must not repeat.
        env.reset(seed=seeds)
        for _ in range(6):
            xy = fields(env, env.get_obs())["cube_xy"]
            draws.append((xy - env.manipulated.pose.p[:, :2]).clone())
            env.step(act(env))
    assert torch.equal(draws.pop(18), draws[0])
    sample = torch.stack(draws[:18])
    assert len(sample.view(-1, 2).unique(dim=0)) == 18 * count
    n = sample.numel() // 2
    std = sample.view(-1, 2).std(dim=0)
    # Five standard errors of a standard deviation.
    assert torch.allclose(std, torch.tensor([0.01, 0.0025]), rtol=5 / math.sqrt(2 * n))
    # Neither steps nor axes have to do with one another.
    scaled, limit = sample / std, 5 / math.sqrt(n)
    assert (scaled.view(-1, 2).mean(dim=0).abs() < limit).all()
    assert (scaled[1:] * scaled[:-1]).mean().abs() < limit
    assert scaled.prod(dim=-1).mean().abs() < limit


# ----------------------------------------------------------------------- reward


def test_directions_towards_plus_x_cost_more():
    env, _ = alike("directional_reward", reward_mode="normalized_dense")
    plain = scene(num_envs=3, reward_mode="normalized_dense")
    plain.reset(seed=SEEDS)
    for xy, share in (((1.0, 0.0), 1.0), ((-1.0, 0.0), 0.0), ((0.0, 1.0), 0.0), ((0.5, 0.5), 0.5)):
        # A second step, at its full speed.
        for _ in range(2):
            before = env.agent.tcp_pose.p.clone()
            obs, reward, _, _, info = env.step(act(env, xy=xy))
            truth, expected, *_ = plain.step(act(env, xy=xy))
        cost = info["extra_cost"]
        moved = (env.agent.tcp_pose.p - before)[:, 0]
        assert torch.allclose(cost, STRENGTHS * (moved / 0.03).clamp(0, 1), atol=1e-6)
        assert torch.allclose(cost, STRENGTHS * share, atol=0.12)
        assert torch.allclose(reward, expected - cost, atol=1e-6)
        assert torch.equal(obs, truth)
    assert not env.reset(seed=SEEDS)[1]["extra_cost"].any()


def test_success_costs_nothing():
    env = scene("directional_reward:1")
    state = env.get_state_dict()
    state["actors"]["goal_site"][:] = state["actors"]["cube"]
    state["actors"]["goal_site"][0, 2] += 0.1
    env.set_state_dict(state)
    _, reward, _, _, info = env.step(act(env, xy=(0.15, 0.0)))
    assert info["success"].tolist() == [False, True]
    assert info["extra_cost"][0] > 0
    assert info["extra_cost"][1] == 0
    assert reward[1] == 1


def test_steering_agents_pay_for_it():
    env = scene("directional_reward", STRENGTHS)
    latent = LatentNoiseEnv(env, NoiseIsAction(4))
    latent.reset(SEEDS)
    low, _ = task_class("PickCube-v1").feasible_return(0.9, 4, step_cost=2.0)
    assert low == pytest.approx(2 * -40.0)
    towards_plus_x = act(env, xy=(1.0, 0.0))[:, None].repeat(1, 4, 1)
    latent.step(towards_plus_x)
    before = env.agent.tcp_pose.p.clone()
    reward = latent.step(towards_plus_x).reward
    moved = (env.agent.tcp_pose.p - before)[:, 0]
    assert reward[0] == -4
    assert torch.allclose(reward, -4 - STRENGTHS * moved / 0.03, atol=0.05)


# ----------------------------------------------------------------------- resets


@pytest.mark.parametrize("task", ["PushCube-v1", "StackCube-v1"])
def test_spawn_sector_turns_the_scene_into_a_wedge(task):
    count = 24
    strengths = torch.tensor([0.0, 0.5, 1.0]).repeat(count // 3)
    seeds = list(range(count))
    plain = shared(task, count)
    env = make(task, num_envs=count, variant="spawn_sector", strength=strengths)
    for e in (plain, env):
        e.reset(seed=seeds)
    check_wedge(plain, env, strengths, slice(None))
    # A partial reset places the same way and leaves the others where they are.
    some = torch.tensor([1, 2, 5, 9])
    before = env.manipulated.pose.p.clone()
    for e in (plain, env):
        e.reset(seed=[100, 101, 102, 103], options={"env_idx": some})
    check_wedge(plain, env, strengths, some)
    others = torch.tensor([i for i in range(count) if i not in some])
    assert torch.equal(env.manipulated.pose.p[others], before[others])


def check_wedge(plain, env, strengths, rows):
    def bearing(e):
        p = e.manipulated.pose.p[rows]
        return torch.atan2(p[:, 1], p[:, 0])

    shrunk = bearing(plain) * (1 - 7 / 8 * strengths[rows])
    assert torch.allclose(bearing(env), shrunk, atol=1e-5)
    assert (bearing(env)[strengths[rows] == 1].abs() <= math.radians(22.5) + 1e-5).all()
    assert torch.equal(env.agent.tcp_pose.p, plain.agent.tcp_pose.p)
    # The turn of the whole scene: everything but hand and bearing is as it was.
    turn = bearing(env) - bearing(plain)
    for name, truth in plain.get_state_dict()["actors"].items():
        if name == "table-workspace":
            continue
        indices = torch.arange(env.num_envs)[rows].tolist()
        for row, angle in zip(indices, turn.tolist(), strict=True):
            state = {"actors": {name: truth[row : row + 1]}, "articulations": {}}
            turned = env.transform_state(state, angle)["actors"][name][0]
            assert torch.allclose(env.get_state_dict()["actors"][name][row], turned, atol=1e-5)
