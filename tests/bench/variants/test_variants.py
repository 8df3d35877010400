"""Variants: parsing, strengths, and action_gain in the simulation."""

import pytest
import torch

from bench.tasks import make
from bench.variants import describe, parse, variant_names
from policies.errors import UserError


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("action_gian:0.5", "did you mean 'action_gain'"),
        ("", "valid: none, action_gain"),
        ("wind:0.5", "valid: none, action_gain"),
        ("action_gain", "needs a strength"),
        ("action_gain:", "no strength can be read"),
        ("action_gain:much", "no strength can be read"),
        ("action_gain:nan", "no strength can be read"),
        ("action_gain:1.5", r"\[0, 1\]"),
        ("action_gain:-0.1", r"\[0, 1\]"),
        ("action_gain:0.1+action_gain:0.2", "named twice"),
        ("action_gain:0.1+", "there is no variant ''"),
        ("none+action_gain:0.1", "there is no variant 'none'"),
    ],
)
def test_bad_text_is_explained(text, part):
    with pytest.raises(UserError, match=part) as error:
        parse(text)
    assert "\n" not in str(error.value)


def test_parse_and_describe():
    assert variant_names() == ["action_gain"]
    assert parse("none") == ()
    assert parse("action_gain:0") == ()
    (variant,) = parse("action_gain:0.5")
    assert variant.strength == 0.5
    assert describe((variant,)) == "action_gain:0.5"
    assert describe(()) == "none"
    (variant,) = parse("action_gain", 0.25)
    assert variant.strength == 0.25
    with pytest.raises(UserError, match="given twice"):
        parse("action_gain:0.5", 0.5)
    with pytest.raises(UserError, match=r"\[0, 1\]"):
        parse("action_gain", torch.tensor([0.5, 1.2]))
    with pytest.raises(UserError, match=r"\[0, 1\]"):
        parse("action_gain", "a lot")
    with pytest.raises(UserError, match=r"2 strengths .* for 3 environments"):
        make("PickCube-v1", num_envs=3, variant="action_gain", strength=[0.5, 0.2])


def rollout(**kwargs):
    env = make("PickCube-v1", num_envs=3, **kwargs)
    observations = [env.reset(seed=[1, 2, 3])[0].clone()]
    generator = torch.Generator().manual_seed(0)
    for _ in range(12):
        action = 2 * torch.randn(3, 7, generator=generator)
        observations.append(env.step(action)[0].clone())
    env.close()
    return torch.stack(observations)


@pytest.mark.parametrize("embodiment", ["floating", "panda"])
def test_strength_zero_is_the_unbroken_task_to_the_bit(embodiment):
    plain = rollout(embodiment=embodiment)
    assert torch.equal(plain, rollout(embodiment=embodiment, variant="action_gain:0"))
    strengths = torch.tensor([0.0, 0.5, 0.0])
    mixed = rollout(embodiment=embodiment, variant="action_gain", strength=strengths)
    assert torch.equal(plain[:, [0, 2]], mixed[:, [0, 2]])
    assert not torch.equal(plain[:, 1], mixed[:, 1])


def test_action_gain_scales_one_axis():
    strengths = torch.tensor([0.0, 0.5, 1.0])
    env = make("PickCube-v1", num_envs=3, variant="action_gain", strength=strengths)
    for axis, gains in ((0, 1 - 0.6 * strengths), (1, torch.ones(3))):
        env.reset(seed=[5, 5, 5])
        before = env.agent.tcp_pose.p.clone()
        action = torch.zeros(3, 7)
        # Far beyond the bound: commanding more does not make up for the gain.
        action[:, axis] = 10.0
        for _ in range(3):
            env.step(action)
        env.step(torch.zeros(3, 7))
        moved = (env.agent.tcp_pose.p - before)[:, axis]
        assert torch.allclose(moved, 0.09 * gains, atol=2e-3)


def test_policy_actions_are_not_changed_in_place():
    env = make("PickCube-v1", num_envs=2, variant="action_gain:1")
    env.reset(seed=[0, 1])
    action = torch.full((2, 7), 0.5)
    env.step(action)
    assert torch.equal(action, torch.full((2, 7), 0.5))
