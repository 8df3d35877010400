"""The spread of decoded actions over the noise."""

import json

import pytest
import torch

from symsteer.errors import UserError
from symsteer.policies import steerability
from symsteer.policies.normalizer import clip_blocks
from symsteer.policies.steerability import action_spread, jumps
from symsteer.policies.training.demonstrations import make_chunks


def test_diverse_demonstrations_spread_more_than_clean_ones(world):
    spread = {
        noise: action_spread(
            world.fit(episodes=world.episodes(24, noise=noise), steps=200, batch_size=64),
            world.observations(32),
        )["action_std"]
        for noise in (0.0, 0.6)
    }
    assert spread[0.6] > 1.5 * spread[0.0]


def test_report_is_seeded_json_with_every_field(trained, world):
    policy = trained(group="C8")
    obs = world.observations(16)
    report = action_spread(policy, obs, draws=4, seed=1)
    assert json.loads(json.dumps(report)) == report
    assert report == action_spread(policy, obs, draws=4, seed=1)
    assert report != action_spread(policy, obs, draws=4, seed=2)
    assert list(report["action_std_by_field"]) == [f.name for f in world.act_layout.fields]
    mean = sum(report["action_std_by_field"].values()) / len(world.act_layout.fields)
    assert report["action_std"] == pytest.approx(mean)


def test_the_definition(trained, world):
    policy = trained(group="C8")
    obs = world.observations(3)
    report = action_spread(policy, obs, draws=5, seed=7)
    noise = torch.randn(5, 3, 8, 7, generator=torch.Generator().manual_seed(7))
    actions = torch.stack([policy.decode(obs, w) for w in noise])[:, :, : policy.execute]
    _, chunks = make_chunks(
        world.episodes(24, noise=0.2), world.act_layout, policy.horizon, ("gripper",)
    )
    chunks = clip_blocks(chunks, world.act_layout, 1.0)
    for name, centered in (("xy", False), ("z", True)):
        part = world.act_layout.slice(name)
        shown = chunks[..., part].flatten(0, 1)
        shown = shown - shown.mean(0) if centered else shown
        raw = actions[..., part].var(dim=0).mean().sqrt()
        ratio = raw / shown.square().mean().sqrt()
        assert report["raw_std_by_field"][name] == pytest.approx(float(raw), rel=1e-5)
        assert report["action_std_by_field"][name] == pytest.approx(float(ratio), rel=1e-5)


def test_what_never_moves_is_left_out(world):
    episodes = [(o, a.clone()) for o, a in world.episodes(8, noise=0.2)]
    for _, actions in episodes:
        actions[:, world.act_layout.slice("tilt")] = 0.0
    policy = world.fit(episodes=episodes, steps=5)
    by_field = action_spread(policy, world.observations(4))["action_std_by_field"]
    assert by_field["tilt"] is None
    assert by_field["xy"] is not None


def test_a_spread_needs_observations_and_draws(trained, world):
    with pytest.raises(UserError):
        action_spread(trained(group="C8"), world.observations(4), draws=1)
    with pytest.raises(UserError):
        action_spread(trained(group="C8"), torch.zeros(0, world.obs_layout.dim))


def test_without_a_change_nothing_jumps(trained, world, monkeypatch):
    monkeypatch.setattr(steerability, "NUDGE", 0.0)
    assert jumps(trained(group="C8"), world.observations(8)) == {"median": 0, "high": 0, "share": 0}


def test_jumps_are_where_the_frame_of_a_canonical_policy_jumps(trained, world):
    obs = world.observations(64)
    near = obs.clone()
    near[:, world.obs_layout.slice("goal")] *= 1e-3
    for name, options in (("canonical", {"anchor": "goal"}), ("edp", {"group": "C8"})):
        policy = trained(name, **options)
        far_away, at_the_jump = jumps(policy, obs), jumps(policy, near)
        assert 0 < far_away["median"] < 0.05
        assert 0 <= far_away["share"] < 0.1
        assert (at_the_jump["high"] > 0.1) == (name == "canonical")
    assert jumps(policy, obs, seed=1) != far_away == jumps(policy, obs)
