"""Variants of what is commanded, observed, paid, and where episodes begin."""

import math

import pytest
import torch

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
    env.reset(seed=SEEDS)
    before = env.agent.tcp_pose.p.clone()
    for _ in range(4):
        env.step(act(env, xy=(1.0, 0.0)))
    drift = (env.agent.tcp_pose.p - before)[:, 0]
    drift = ((drift - drift[0]) / 4).tolist()
    assert 0.008 < drift[2] < 0.016
    assert drift[1] == pytest.approx(drift[2] / 2, rel=0.2)


# ----------------------------------------------------------------------- observation


@pytest.mark.parametrize(
    ("variant", "metres", "signs"),
    [
        ("perception_bias", 0.02, {"cube_xy": 1, "tcp_to_cube_xy": 1, "cube_to_goal_xy": -1}),
        ("frame_offset", -0.05, dict.fromkeys(("tcp_xy", "cube_xy", "goal_xy"), 1)),
    ],
)
def test_some_fields_shift_by_a_vector(variant, metres, signs):
    env, seen = alike(variant)
    shift = torch.stack([metres * STRENGTHS, torch.zeros(3)], dim=1)
    for name, value in seen.items():
        moved = signs[name] * shift if name in signs else torch.zeros_like(value)
        assert torch.allclose(value - value[:1], moved, atol=1e-7), name
    assert torch.equal(env.policy_origin, -shift * (variant == "frame_offset"))


def test_frame_rotation_turns_the_observation():
    """It commutes with rotations and not with reflections."""
    env, seen = alike("frame_rotation")
    layout, obs = env.observation_layout, torch.cat(list(seen.values()), dim=1)
    for row, strength in enumerate(STRENGTHS.tolist()):
        expected = layout.transform(obs[:1], math.radians(45) * strength)[0]
        assert torch.allclose(obs[row], expected, atol=1e-6)
    state = env.get_state_dict()
    for angle, reflect in Group.parse("D8").elements:
        env.set_state_dict(env.transform_state(state, angle, reflect))
        gap = (env.get_obs() - layout.transform(obs, angle, reflect))[2].abs().max()
        assert gap > 0.05 if reflect else gap < 1e-5, (angle, reflect, gap)


def test_camera_rotation_turns_objects_alone():
    """It commutes with rotations and not with reflections."""
    env, seen = alike("camera_rotation")
    layout, obs = env.observation_layout, torch.cat(list(seen.values()), dim=1)
    for row, strength in enumerate(STRENGTHS.tolist()):
        turned = layout.transform(obs[:1], math.radians(10) * strength)[0]
        for field in layout.fields:
            here, told = layout.slice(field.name), field.name.startswith("cube")
            if "_to_" not in field.name and not field.name.startswith("grasp"):
                expected = turned if told else obs[0]
                assert torch.allclose(obs[row, here], expected[here], atol=1e-6), field.name
    state = env.get_state_dict()
    for angle, reflect in Group.parse("D8").elements:
        env.set_state_dict(env.transform_state(state, angle, reflect))
        gap = (env.get_obs() - layout.transform(obs, angle, reflect))[2].abs().max()
        assert gap > 0.01 if reflect else gap < 1e-5, (angle, reflect, gap)


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
    count, draws = 32, []
    env = scene("observation_noise:1", num_envs=count)
    for seeds in (list(range(count)), None, None, list(range(count))):
        # Without seeds ManiSkill keeps an environment's seed; the noise must not repeat.
        env.reset(seed=seeds)
        for _ in range(4):
            xy = fields(env, env.get_obs())["cube_xy"]
            draws.append((xy - env.manipulated.pose.p[:, :2]).clone())
            env.step(act(env))
    sample = torch.stack(draws[:12])
    assert torch.equal(draws[12], draws[0])
    assert len(sample.view(-1, 2).unique(dim=0)) == 12 * count
    n = sample.numel() // 2
    std = sample.view(-1, 2).std(dim=0)
    # Five standard errors of a standard deviation.
    assert torch.allclose(std, torch.tensor([0.01, 0.0025]), rtol=5 / math.sqrt(2 * n))
    # Neither steps nor axes have to do with one another.
    scaled, limit = sample / std, 5 / math.sqrt(n)
    for values in (scaled, scaled[1:] * scaled[:-1], scaled.prod(dim=-1, keepdim=True)):
        assert values.flatten(0, 1).mean(dim=0).abs().max() < limit


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
    """A partial reset places the same way and leaves the others where they are."""
    strengths = STRENGTHS.repeat(4)
    plain = shared(task, 12)
    env = make(task, num_envs=12, variant="spawn_sector", strength=strengths)
    some = torch.tensor([1, 2, 5, 9])
    placed = torch.zeros(0)
    for rows, seed in ((torch.arange(12), 0), (some, 100)):
        for e in (plain, env):
            e.reset(seed=[seed + int(i) for i in rows], options={"env_idx": rows})
        whole, wedge = (bearing(e)[rows] for e in (plain, env))
        assert torch.allclose(wedge, whole * (1 - 7 / 8 * strengths[rows]), atol=1e-5)
        assert torch.equal(env.agent.tcp_pose.p, plain.agent.tcp_pose.p)
        # The turn of the whole scene: everything but hand and bearing is as it was.
        for row, turn in zip(rows.tolist(), (wedge - whole).tolist(), strict=True):
            turned = env.transform_state(plain.get_state_dict(), turn)["actors"]
            for name, body in env.get_state_dict()["actors"].items():
                assert torch.allclose(body[row], turned[name][row], atol=1e-5), name
        if len(rows) == 12:
            placed = env.manipulated.pose.p.clone()
    others = [i for i in range(12) if i not in some]
    assert torch.equal(env.manipulated.pose.p[others], placed[others])
    env.close()


def bearing(env):
    p = env.manipulated.pose.p
    return torch.atan2(p[:, 1], p[:, 0])
