"""Training: chunks, augmentation, determinism, learning, matched sizes, mistakes."""

import math

import pytest
import torch

from symsteer.errors import UserError
from symsteer.policies import POLICIES
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.geometry import Group, group_average
from symsteer.policies.networks.denoiser import Denoiser
from symsteer.policies.symmetry.augmented import Augmentation
from symsteer.policies.symmetry.lifted import LiftedDenoiser
from symsteer.policies.training.demonstrations import make_chunks


def test_chunks_end_with_a_held_gripper_and_no_motion(world):
    (obs, actions), *_ = world.episodes(1, length=5)
    seen, chunks = make_chunks([(obs, actions)], world.act_layout, 4, hold=("gripper", "absent"))
    assert torch.equal(seen, obs[:5])
    assert chunks.shape == (5, 4, world.act_layout.dim)
    assert torch.equal(chunks[1], actions[1:5])
    last = chunks[4]
    assert torch.equal(last[0], actions[4])
    gripper = world.act_layout.slice("gripper")
    assert torch.equal(last[:, gripper], actions[4, gripper].expand(4, 1))
    moving = torch.ones(world.act_layout.dim, dtype=torch.bool)
    moving[gripper] = False
    assert (last[1:, moving] == 0).all()
    _, free = make_chunks([(obs, actions)], world.act_layout, 4)
    assert (free[4, 1:] == 0).all()
    # Episodes are never mixed.
    both = make_chunks([(obs, actions), (-obs, -actions)], world.act_layout, 4, hold=("gripper",))
    assert torch.equal(both[1], torch.cat([chunks, -chunks]))


@pytest.mark.parametrize("name", ["SO2", "C8", "D4"])
def test_augmentation_turns_rows_as_the_layout_does(world, name):
    group = Group.parse(name)
    augmentation = Augmentation(group)
    drawn = augmentation.draw(40, torch.Generator().manual_seed(0))
    assert len(drawn.unique()) >= min(8, 40 if name == "SO2" else group.order)
    x = torch.randn(40, 3, world.act_layout.dim, dtype=torch.float64)
    y = augmentation.apply(drawn, x, world.act_layout)
    for i in range(40):
        element = (float(drawn[i]), False) if name == "SO2" else group.elements[drawn[i]]
        assert torch.allclose(y[i], world.act_layout.transform(x[i], *element), atol=1e-6)


@pytest.mark.long
def test_augmented_training_sees_turned_pairs(world):
    """All demonstrations reach east; only the augmented policy learns what west means."""
    generator = torch.Generator().manual_seed(0)
    obs = world.observations(400)
    obs[:, world.obs_layout.slice("tcp")] *= 0.1
    angle = (torch.rand(400, generator=generator) - 0.5) * math.pi / 4
    east = torch.stack([angle.cos(), angle.sin()], dim=-1)
    obs[:, world.obs_layout.slice("goal")] = 0.8 * east
    actions = world.controller(obs)
    episodes = [(o[None].repeat(2, 1), a[None]) for o, a in zip(obs, actions, strict=True)]
    west = world.obs_layout.transform(obs[:64], math.pi)
    expected = world.controller(west)[:, world.act_layout.slice("xy")]
    noise = torch.randn(64, 8, world.act_layout.dim, generator=generator)
    errors = {}
    for name in ("plain", "plain-augmented", "edp"):
        policy = world.fit(episodes=episodes, name=name, steps=250, batch_size=64)
        got = policy.decode(west, noise)[:, 0, world.act_layout.slice("xy")]
        errors[name] = float((got - expected).norm(dim=-1).mean())
    assert errors["plain-augmented"] < 0.5 < 1.0 < errors["plain"]
    assert errors["edp"] < 0.5


@pytest.mark.parametrize("name", list(POLICIES.builtin))
def test_the_same_seed_gives_the_same_policy(world, name):
    first, second, other = (world.fit(name, seed, steps=5) for seed in (3, 3, 4))
    assert first.content_hash() == second.content_hash()
    assert first.training_record["losses"] == second.training_record["losses"]
    assert first.content_hash() != other.content_hash()


def test_a_frame_must_be_a_vector_of_the_observation(world):
    for fields in ({"name": "canonical", "anchor": "goall"}, {"action_frame": "goall"}):
        with pytest.raises(UserError, match="no planar vector 'goall'; did you mean 'goal'"):
            world.untrained(**fields)
    with pytest.raises(UserError, match="valid: tcp, goal"):
        world.untrained(action_frame="rod")


def test_the_anchor_is_the_vector_that_stays_away_from_zero(world):
    episodes = world.episodes(6)
    vectors = {name: world.obs_layout.slice(name) for name in ("tcp", "goal")}
    for steady, other in (("tcp", "goal"), ("goal", "tcp")):
        changed = []
        for obs, actions in episodes:
            obs = obs.clone()
            obs[:, vectors[steady]] /= obs[:, vectors[steady]].norm(dim=-1, keepdim=True)
            obs[0, vectors[other]] = 0
            changed.append((obs, actions))
        assert world.fit("canonical", steps=2, episodes=changed).options.anchor == steady
    assert world.fit("canonical", steps=2, anchor="goal").options.anchor == "goal"


def test_the_averaged_network_is_the_mean_over_the_group(trained, world):
    policy = trained("frame-averaged", group="D4")
    inner, time = policy.denoiser.inner, policy.denoiser.encode_time(torch.tensor([30]))
    x, obs = torch.randn(4, 8, 7), world.observations(4)
    expected = group_average(
        lambda x, obs: inner(x, inner.encode(obs), time),
        (x, obs),
        (world.act_layout, world.obs_layout),
        world.act_layout,
        policy.group,
    )
    found = policy.denoiser(x, policy.denoiser.encode(obs), time)
    assert torch.allclose(found, expected, atol=1e-5)
    assert not torch.allclose(found, inner(x, inner.encode(obs), time), atol=1e-2)
    sizes = [p.parameter_count() for p in (policy, world.untrained(group="D4"))]
    assert sizes[0] == pytest.approx(sizes[1], rel=0.1)


def test_the_policy_keeps_averaged_weights(world):
    last, averaged = (world.fit(ema_decay=decay) for decay in (0.0, 0.9))
    assert last.training_record["losses"] == averaged.training_record["losses"]
    assert last.content_hash() != averaged.content_hash()
    # The average is a point on the way there.
    start = world.fit(steps=1, ema_decay=0.0)

    def distance(a, b):
        pairs = zip(a.denoiser.parameters(), b.denoiser.parameters(), strict=True)
        return sum((x - y).square().sum() for x, y in pairs).sqrt()

    assert 0 < distance(averaged, start) < distance(last, start)


@pytest.mark.parametrize(
    ("name", "network"),
    [("edp", "unet"), ("escnn", "mlp"), ("frame-averaged", "mlp"), ("canonical", "mlp")],
)
def test_an_output_from_zero_forgets_the_noise_until_it_is_trained(world, name, network):
    obs = world.observations(3)
    noises = [torch.randn(3, 8, world.act_layout.dim) for _ in range(2)]
    for zero in (True, False):
        policy = world.untrained(name, network=network, zero_output=zero)
        own, other = (policy.decode(obs, noise) for noise in noises)
        assert torch.equal(own, other) == zero
    trained = world.fit(name, network=network, zero_output=True, steps=5)
    assert not torch.equal(*(trained.decode(obs, noise) for noise in noises))


def test_a_network_of_another_package_must_tell_its_output_layer(world, monkeypatch):
    monkeypatch.setattr(LiftedDenoiser, "output_layers", Denoiser.output_layers)
    world.untrained("edp")
    with pytest.raises(UserError, match="define its output_layers"):
        world.untrained("edp", zero_output=True)


@pytest.mark.parametrize("network", ["mlp", "unet"])
def test_it_learns_the_controller(trained, world, network):
    policy = trained(group="C8", network=network)
    losses = [loss for _, loss in policy.training_record["losses"]]
    assert losses[-1] < 0.5 * losses[0]
    obs = world.observations(64, seed=3)
    noise = torch.randn(64, 8, 7, generator=torch.Generator().manual_seed(0))
    wanted = world.controller(obs).clamp(-1, 1)
    error = (policy.decode(obs, noise)[:, 0] - wanted).square().mean()
    shuffled = (policy.decode(obs.flip(0), noise)[:, 0] - wanted).square().mean()
    assert error < 0.8 * wanted.square().mean()
    assert error < 0.7 * shuffled


def test_record_progress_and_frozen_weights(world):
    calls, before = [], torch.get_rng_state()
    policy = world.fit(progress=lambda *call: calls.append(call))
    assert torch.equal(before, torch.get_rng_state())
    assert isinstance(policy, ChunkPolicy)
    assert calls[-1][:2] == (30, 30)
    record = policy.training_record
    assert record["losses"] == [(step, loss) for step, _, loss in calls]
    assert record["parameters"] == policy.parameter_count()
    assert record["episodes"] == 6
    assert record["chunks"] == sum(len(a) for _, a in world.episodes(6))
    assert not policy.training
    assert not any(p.requires_grad for p in policy.parameters())


def test_actions_beyond_the_environments_bound_are_bounded_first(world):
    """The environment executes bounded actions; imitating the excess would be wrong."""
    episodes = [(o, 3 * a) for o, a in world.episodes(4)]
    policy = world.fit(episodes=episodes, steps=2)
    assert policy.act_normalizer.scale.max() <= 1 + 1e-6


@pytest.mark.parametrize("network", ["mlp", "unet"])
@pytest.mark.parametrize("name", ["plain", "plain-augmented"])
def test_plain_policies_have_matched_parameters_and_no_group(world, name, network):
    equivariant = world.untrained(network=network, width=64)
    policy = world.untrained(name, network=network, width=64)
    assert (str(equivariant.group), str(policy.group)) == ("C8", "C1")
    assert abs(policy.parameter_count() / equivariant.parameter_count() - 1) < 0.05
    assert policy.options.steps == 4 * equivariant.options.steps
    assert policy.options == policy.options.resolved(world.obs_layout, world.act_layout)
    free = {"match_parameters": False, "match_compute": False}
    options = world.untrained(name, network=network, width=64, **free).options
    assert (options.width, options.steps) == (64, equivariant.options.steps)


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
def test_bad_demonstrations_raise_user_errors(world, episodes):
    with pytest.raises(UserError):
        world.fit(episodes=episodes)
