"""Training: chunks, augmentation, determinism, learning, matched sizes, mistakes."""

import math

import pytest
import torch

from symsteer.errors import UserError
from symsteer.policies import POLICIES
from symsteer.policies.geometry import Group, group_average
from symsteer.policies.networks.denoiser import Denoiser
from symsteer.policies.symmetry.augmented import Augmentation
from symsteer.policies.symmetry.lifted import LiftedDenoiser
from symsteer.policies.training.demonstrations import make_chunks
from symsteer.policies.training.gradient import GradientPolicy
from tests.policies.conftest import (
    ACT,
    OBS,
    controller,
    fit,
    make_episodes,
    noises,
    observations,
    untrained,
)


def test_chunks_end_with_a_held_gripper_and_no_motion():
    (obs, actions), *_ = make_episodes(1, length=5)
    seen, chunks = make_chunks([(obs, actions)], ACT, 4, hold=("gripper", "absent"))
    assert torch.equal(seen, obs[:5])
    assert torch.equal(chunks[1], actions[1:5])
    last = chunks[4]
    assert torch.equal(last[0], actions[4])
    gripper = ACT.slice("gripper")
    assert torch.equal(last[:, gripper], actions[4, gripper].expand(4, 1))
    last[:, gripper] = 0
    assert (last[1:] == 0).all()
    _, free = make_chunks([(obs, actions)], ACT, 4)
    assert (free[4, 1:] == 0).all()
    # Episodes are never mixed.
    _, both = make_chunks([(obs, actions), (-obs, -actions)], ACT, 4)
    assert torch.equal(both, torch.cat([free, -free]))


@pytest.mark.parametrize("name", ["SO2", "C8", "D4"])
def test_augmentation_turns_rows_as_the_layout_does(name):
    group = Group.parse(name)
    augmentation = Augmentation(group)
    drawn = augmentation.draw(40, torch.Generator().manual_seed(0))
    assert len(drawn.unique()) >= 8
    x = torch.randn(40, 3, ACT.dim, dtype=torch.float64)
    y = augmentation.apply(drawn, x, ACT)
    for i in range(40):
        element = (float(drawn[i]), False) if name == "SO2" else group.elements[drawn[i]]
        assert torch.allclose(y[i], ACT.transform(x[i], *element), atol=1e-6)


@pytest.mark.parametrize("augmentation", ["SO2", "D4"])
def test_observation_and_chunk_are_turned_together_in_training(augmentation):
    """The controller commutes with all that turns them."""
    policy, before = untrained("plain-augmented", augmentation=augmentation), observations(20)
    generator = torch.Generator().manual_seed(0)
    obs, chunks = policy.augment(before, controller(before)[:, None], generator)
    assert (obs - before).norm(dim=1).min() < 1e-6 or augmentation == "SO2"
    assert (obs - before).norm(dim=1).max() > 0.5
    assert torch.allclose(controller(obs), chunks[:, 0], atol=1e-5)
    losses = [fit(name, steps=1).training_record["losses"] for name in ("plain", policy.name)]
    assert losses[0] != losses[1]


@pytest.mark.parametrize("name", list(POLICIES.builtin))
def test_the_same_seed_gives_the_same_policy(name):
    first, second = (fit(name, 3, steps=3) for _ in range(2))
    assert first.content_hash() == second.content_hash()
    assert first.training_record.get("losses") == second.training_record.get("losses")
    if isinstance(first, GradientPolicy):
        assert first.content_hash() != fit(name, 4, steps=1).content_hash()


def test_a_frame_must_be_a_vector_of_the_observation():
    for fields in ({"name": "canonical", "anchor": "goall"}, {"action_frame": "goall"}):
        with pytest.raises(UserError, match="no planar vector 'goall'; did you mean 'goal'"):
            untrained(**fields)
    with pytest.raises(UserError, match="valid: tcp, goal"):
        untrained(action_frame="rod")


@pytest.mark.parametrize(("steady", "other"), [("tcp", "goal"), ("goal", "tcp")])
def test_the_anchor_is_the_vector_that_stays_away_from_zero(steady, other):
    episodes = make_episodes(6)
    for obs, _ in episodes:
        obs[:, OBS.slice(steady)] /= obs[:, OBS.slice(steady)].norm(dim=-1, keepdim=True)
        obs[0, OBS.slice(other)] = 0
    assert fit("canonical", steps=1, episodes=episodes).options.anchor == steady
    assert fit("canonical", steps=1, episodes=episodes, anchor="goal").options.anchor == "goal"


def test_the_averaged_network_is_the_mean_over_the_group(trained):
    policy = trained("frame-averaged", group="D4", steps=15)
    inner, time = policy.denoiser.inner, policy.denoiser.encode_time(torch.tensor([30]))
    x, obs = noises(4), observations(4)
    expected = group_average(
        lambda x, obs: inner(x, inner.encode(obs), time), (x, obs), (ACT, OBS), ACT, policy.group
    )
    average = policy.denoiser(x, policy.denoiser.encode(obs), time)
    assert torch.allclose(average, expected, atol=1e-5)
    assert not torch.allclose(average, inner(x, inner.encode(obs), time), atol=1e-2)
    lifted = untrained(group="D4").parameter_count()
    assert policy.parameter_count() == pytest.approx(lifted, rel=0.1)


def test_the_policy_keeps_averaged_weights():
    last, averaged = (fit(ema_decay=decay) for decay in (0.0, 0.9))
    assert last.training_record["losses"] == averaged.training_record["losses"]
    # The average is a point on the way there.
    start = fit(steps=1, ema_decay=0.0)

    def distance(a, b):
        pairs = zip(a.denoiser.parameters(), b.denoiser.parameters(), strict=True)
        return sum((x - y).square().sum() for x, y in pairs).sqrt()

    assert 0 < distance(averaged, start) < distance(last, start)


@pytest.mark.parametrize(
    ("name", "network"),
    [("edp", "unet"), ("escnn", "mlp"), ("frame-averaged", "mlp"), ("canonical", "mlp")],
)
def test_an_output_from_zero_forgets_the_noise_until_it_is_trained(name, network):
    def differs(policy):
        own, other = (policy.decode(observations(3), noises(3, seed)) for seed in (0, 1))
        return not torch.equal(own, other)

    assert not differs(untrained(name, network=network, zero_output=True))
    assert differs(untrained(name, network=network))
    assert differs(fit(name, network=network, zero_output=True, steps=5))


def test_a_network_of_another_package_must_tell_its_output_layer(monkeypatch):
    monkeypatch.setattr(LiftedDenoiser, "output_layers", Denoiser.output_layers)
    untrained("edp")
    with pytest.raises(UserError, match="define its output_layers"):
        untrained("edp", zero_output=True)


@pytest.mark.parametrize("network", ["mlp", "unet"])
def test_it_learns_the_controller(trained, network):
    policy = trained(group="C8", network=network)
    losses = [loss for _, loss in policy.training_record["losses"]]
    assert losses[-1] < 0.5 * losses[0]
    obs, noise = observations(64, seed=3), noises(64, seed=0)
    wanted = controller(obs).clamp(-1, 1)
    error = (policy.decode(obs, noise)[:, 0] - wanted).square().mean()
    shuffled = (policy.decode(obs.flip(0), noise)[:, 0] - wanted).square().mean()
    assert error < 0.8 * wanted.square().mean()
    assert error < 0.7 * shuffled


def test_record_progress_and_frozen_weights():
    calls, before = [], torch.get_rng_state()
    policy = fit(progress=lambda *call: calls.append(call))
    assert torch.equal(before, torch.get_rng_state())
    assert calls[-1][:2] == (30, 30)
    record = policy.training_record
    assert record["losses"] == [(step, loss) for step, _, loss in calls]
    assert record["parameters"] == policy.parameter_count()
    assert record["episodes"] == 6
    assert record["chunks"] == sum(len(a) for _, a in make_episodes(6))
    assert not policy.training
    assert not any(p.requires_grad for p in policy.parameters())


def test_actions_beyond_the_environments_bound_are_bounded_first():
    """The environment executes bounded actions; imitating the excess would be wrong."""
    policy = fit(episodes=[(o, 3 * a) for o, a in make_episodes(4)], steps=1)
    assert policy.act_normalizer.scale.max() <= 1 + 1e-6


@pytest.mark.parametrize(("name", "network"), [("plain", "mlp"), ("plain-augmented", "unet")])
def test_plain_policies_have_matched_parameters_and_no_group(name, network):
    sizes = {"network": network, "width": 64}
    equivariant, policy = untrained(**sizes), untrained(name, **sizes)
    assert (str(equivariant.group), str(policy.group)) == ("C8", "C1")
    assert abs(policy.parameter_count() / equivariant.parameter_count() - 1) < 0.05
    assert policy.options.steps == 4 * equivariant.options.steps
    assert policy.options == policy.options.resolved(OBS, ACT)
    free = untrained(name, **sizes, match_parameters=False, match_compute=False).options
    assert (free.width, free.steps) == (64, equivariant.options.steps)


@pytest.mark.parametrize(
    "mistake",
    [
        {"network": "transformer"},
        {"prediction": "velocity"},
        {"group": "E8"},
        {"group": "SO2"},
        {"name": "plain", "group": "SO2"},
        {"name": "plain-augmented", "augmentation": "everything"},
        {"name": "canonical", "symmetry": "D4"},
        {"name": "canonical", "symmetry": "SO2"},
        {"name": "frame-averaged", "group": "SO2"},
        {"process": "diffuse"},
        {"process": "flow", "prediction": "epsilon"},
        {"observation_noise": -0.1},
        {"orbit_targets": True},
        {"snr_cap": 0.0},
        {"horizon": 0},
        {"execute": 9},
        {"network": "unet", "horizon": 7, "execute": 4},
        {"sampling_steps": 0},
        {"sampling_steps": 101},
        {"diffusion_steps": 1, "sampling_steps": 1},
        {"learning_rate": 0.0},
        {"ema_decay": 1.0},
        {"steps": 0},
    ],
)
def test_bad_options_raise_user_errors(mistake):
    fields = dict(mistake)
    options = POLICIES.get(fields.pop("name", "edp")).Options
    with pytest.raises(UserError) as error:
        options(**fields)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "episodes",
    [
        [],
        [(torch.zeros(5, 3), torch.zeros(4, 7))],
        [(torch.zeros(5, 9), torch.zeros(4, 6))],
        [(torch.zeros(3, 9), torch.zeros(4, 7))],
        [(torch.zeros(1, 9), torch.zeros(0, 7))],
        [(torch.full((5, 9), math.nan), torch.zeros(4, 7))],
    ],
)
def test_bad_demonstrations_raise_user_errors(episodes):
    with pytest.raises(UserError):
        fit(episodes=episodes)
