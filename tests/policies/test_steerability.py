"""The spread of decoded actions over the noise."""

import json

import pytest
import torch

from policies.base import PolicyConfig
from policies.steerability import action_spread
from policies.training import train_policy


def test_diverse_demonstrations_spread_more_than_clean_ones(world):
    config = PolicyConfig(**world.small, steps=200, batch_size=64)
    spread = {
        noise: action_spread(
            train_policy(
                config, world.episodes(24, noise=noise), world.obs_layout, world.act_layout
            ),
            world.observations(32),
        )["action_std"]
        for noise in (0.0, 0.6)
    }
    assert spread[0.6] > 2 * spread[0.0]


def test_report_is_seeded_json_with_every_field(trained, world):
    policy = trained(group="C8")
    obs = world.observations(16)
    report = action_spread(policy, obs, draws=4, seed=1)
    assert json.loads(json.dumps(report)) == report
    assert report == action_spread(policy, obs, draws=4, seed=1)
    assert report != action_spread(policy, obs, draws=4, seed=2)
    by_field = report["action_std_by_field"]
    assert list(by_field) == [f.name for f in world.act_layout.fields]
    sizes = [f.dim for f in world.act_layout.fields]
    mean = sum(s * n for s, n in zip(by_field.values(), sizes, strict=True)) / sum(sizes)
    assert report["action_std"] == pytest.approx(mean)


def test_the_definition(trained, world):
    policy = trained(group="C8")
    obs = world.observations(3)
    report = action_spread(policy, obs, draws=5, seed=7)
    noise = torch.randn(5, 3, 8, 7, generator=torch.Generator().manual_seed(7))
    actions = torch.stack([policy.decode(obs, w) for w in noise])
    actions = policy.act_normalizer.normalize(actions)[:, :, : policy.execute]
    assert report["action_std"] == pytest.approx(float(actions.std(dim=0).mean()), rel=1e-6)
