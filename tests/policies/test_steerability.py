"""The spread of decoded actions over the noise, and how much they change with the observation."""

import pytest
import torch

from symsteer.errors import UserError
from symsteer.policies import steerability
from symsteer.policies.normalizer import clip_blocks
from symsteer.policies.steerability import STILL, action_spread, jump
from symsteer.policies.training.demonstrations import make_chunks
from tests.policies.conftest import ACT, OBS, fit, make_episodes, observations


def test_diverse_demonstrations_spread_more_than_clean_ones():
    clean, diverse = (
        action_spread(
            fit(episodes=make_episodes(24, noise=noise), steps=200, batch_size=64),
            observations(32),
        )
        for noise in (0.0, 0.6)
    )
    assert diverse > 1.5 * clean


def test_the_definition():
    episodes = make_episodes(8, noise=0.2)
    for _, actions in episodes:
        actions[:, ACT.slice("tilt")] = 0.0  # never moves, so it is left out
    policy, obs = fit(episodes=episodes, steps=5), observations(3)
    noise = torch.randn(5, 3, 8, 7, generator=torch.Generator().manual_seed(7))
    actions = torch.stack([policy.decode(obs, w) for w in noise])[:, :, : policy.execute]
    _, chunks = make_chunks(episodes, ACT, policy.horizon, ("gripper",))
    chunks = clip_blocks(chunks, ACT, 1.0)
    ratios = []
    for field in ACT.fields:
        part = ACT.slice(field.name)
        shown = chunks[..., part].flatten(0, 1)
        # Numbers that change sign under a reflection have no mean.
        centred = field.frequency == 0 and not field.odd
        deviation = (shown - shown.mean(0) * centred).square().mean().sqrt()
        if deviation > STILL:
            ratios.append(actions[..., part].var(dim=0).mean().sqrt() / deviation)
    assert len(ratios) == len(ACT.fields) - 1
    spread = action_spread(policy, obs, draws=5, seed=7)
    assert spread == pytest.approx(float(sum(ratios) / len(ratios)), rel=1e-5)
    assert spread != action_spread(policy, obs, draws=5, seed=8)
    for few, draws in ((obs, 1), (obs[:0], 2)):
        with pytest.raises(UserError, match="at least 1 observation and 2 draws"):
            action_spread(policy, few, draws)


def test_a_canonical_policy_jumps_where_its_frame_does(trained, monkeypatch):
    obs = observations(64)
    near = obs.clone()
    near[:, OBS.slice("goal")] *= 1e-3
    for name, options in (("canonical", {"anchor": "goal"}), ("edp", {"group": "C8"})):
        policy = trained(name, **options)
        assert jump(policy, obs[:4]) > 0
        assert (jump(policy, near) > 0.1) == (name == "canonical")
    assert jump(policy, obs, seed=1) != jump(policy, obs) < 0.1
    monkeypatch.setattr(steerability, "NUDGE", 0.0)
    assert jump(policy, obs) == 0
