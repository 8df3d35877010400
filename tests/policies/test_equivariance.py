"""decode(g s, g w) = g decode(s, w): exactly, for every element; and not for wrong layouts."""

import math
from dataclasses import replace

import pytest
import torch

from symsteer.policies.geometry import Group, Layout, equivariance_error
from symsteer.policies.normalizer import Normalizer
from symsteer.policies.symmetry.lifted import EquivariantDiffusionPolicy
from tests.marks import long_except
from tests.policies.conftest import OBS

TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-10}


def decode_error(policy, world, group, dtype, obs_layout=None, act_layout=None):
    """Relative equivariance error of decode; inputs are transformed in float64.

    ``obs_layout`` and ``act_layout`` say how the world turns; by default as the policy believes.
    """
    obs_layout, act_layout = obs_layout or policy.obs_layout, act_layout or policy.act_layout
    generator = torch.Generator().manual_seed(1)
    obs = world.observations(16) * 1.5
    noise = 1.5 * torch.randn(16, policy.horizon, act_layout.dim, generator=generator)
    return equivariance_error(
        lambda *inputs: policy.decode(*(x.to(dtype) for x in inputs)),
        (obs.double(), noise.double()),
        (obs_layout, act_layout),
        act_layout,
        group,
    )


IRREPS = {"channels": 8, "width": 8, "depth": 1, "zero_output": False}
WAYS = {
    **{name: {"group": name} for name in ("C4", "C8", "D4", "C16", "D8")},
    **{f"{name}, U-Net": {"group": name, "network": "unet"} for name in ("C4", "C8", "D4")},
    "frame-averaged": {"policy": "frame-averaged", "group": "C8"},
    "frame-averaged, D4": {"policy": "frame-averaged", "group": "D4"},
    "frame-averaged, U-Net": {"policy": "frame-averaged", "group": "C4", "network": "unet"},
    "canonical": {"policy": "canonical"},
    "canonical, anchor": {"policy": "canonical", "anchor": "tcp"},
    "escnn": {"policy": "escnn", "group": "C8"},
    "escnn, D4": {"policy": "escnn", "group": "D4"},
    "escnn, U-Net": {"policy": "escnn", "group": "C4", "network": "unet"},
    "so2": {"policy": "so2", **IRREPS},
    "spherical": {"policy": "spherical", **IRREPS},
    "relative actions": {"group": "D4", "action_frame": "goal"},
    "averaged, relative actions": {"policy": "frame-averaged", "action_frame": "tcp"},
    "flow": {"group": "C8", "process": "flow"},
    "velocity": {"group": "C8", "process": "flow", "prediction": "velocity"},
    "orbit": {"group": "D4", "orbit_targets": True, "observation_noise": 0.1},
    "epsilon": {"group": "C8", "prediction": "epsilon"},
}

USUAL_WAYS = [way for way in WAYS if way not in ("escnn, D4", "escnn, U-Net")]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("way", long_except(list(WAYS), *USUAL_WAYS))
def test_every_way_to_be_symmetric_is_exact(trained, world, way, dtype):
    """Before and after training."""
    fields, tolerance = {**WAYS[way]}, TOLERANCE[dtype]
    name = fields.pop("policy", "edp")
    if way == "epsilon" and dtype == torch.float32:
        # sqrt(a_t) = 5e-4 at the first level divides the rounding errors.
        tolerance = 5e-3
    for policy in (world.untrained(name, **fields), trained(name, **fields, steps=30)):
        policy.to(dtype)
        try:
            assert policy.group.order > 1
            assert decode_error(policy, world, policy.group, dtype) <= tolerance
            if name in ("canonical", "so2", "spherical"):
                assert decode_error(policy, world, Group.parse("C5"), dtype) <= tolerance
        finally:
            policy.float()


def test_the_frame_of_a_chunk_is_needed(trained, world, monkeypatch):
    """Relative actions in the world's frame would not be symmetric."""
    policy = trained(group="D4", action_frame="goal")
    monkeypatch.setattr(policy.frame, "leave", lambda chunk, angle: chunk)
    assert decode_error(policy, world, policy.group, torch.float32) > 1e-2


def test_a_frame_may_be_an_odd_vector(world):
    """Columns of a mirrored rotation change sign; the frame then turns by half a turn."""
    odd = changed(changed(OBS, "goal", odd=True), "twist", odd=False)
    torch.manual_seed(0)
    options = world.options(group="D4", action_frame="goal")
    policy = EquivariantDiffusionPolicy(options, odd, world.act_layout)
    policy.denoiser.project.weight.mul_(5)
    policy.freeze()
    error = decode_error(policy, world, policy.group, torch.float32, obs_layout=odd)
    assert error <= 1e-5
    even = world.obs_layout
    assert decode_error(policy, world, policy.group, torch.float32, obs_layout=even) > 1e-2


@pytest.mark.parametrize("network", ["mlp", "unet"])
def test_bounds_are_active_in_these_tests(trained, world, network):
    """Equivariance of bounds means nothing where nothing is bounded."""
    policy = trained(group="C8", network=network)
    obs = world.observations(16) * 1.5
    noise = 1.5 * torch.randn(16, policy.horizon, 7, generator=torch.Generator().manual_seed(1))
    actions = policy.decode(obs, noise)
    norms = actions[..., world.act_layout.slice("xy")].norm(dim=-1)
    assert (norms > 0.999).float().mean() > 0.1
    assert norms.max() <= 1 + 1e-6
    assert actions.abs().max() <= 1


@pytest.mark.parametrize("name", ["C8", "D4"])
def test_other_angles_are_not_symmetries(trained, world, name):
    """The group is all that is built in; so the error of other angles is not zero."""
    policy = trained(group=name)
    assert decode_error(policy, world, Group.parse("C5"), torch.float32) > 1e-3


def changed(layout, name, **changes):
    return Layout([replace(f, **changes) if f.name == name else f for f in layout.fields])


WRONG_LAYOUTS = {
    "observation's rod turns twice as fast": ("obs", "rod", {"frequency": 1}),
    "observation's goal is a vector": ("obs", "goal", {"frequency": 0, "multiplicity": 2}),
    "action's tilt turns once": ("act", "tilt", {"frequency": 2}),
    "action's xy is a vector": ("act", "xy", {"frequency": 0, "multiplicity": 2}),
    "action's yaw is odd": ("act", "yaw", {"odd": False}),
    "action's tilt is odd": ("act", "tilt", {"odd": False}),
}


@pytest.mark.parametrize("mistake", WRONG_LAYOUTS)
def test_a_wrong_layout_shows(world, mistake):
    """The policy believes one layout; the world turns by the right one."""
    which, name, changes = WRONG_LAYOUTS[mistake]
    layouts = {"obs": world.obs_layout, "act": world.act_layout}
    layouts[which] = changed(layouts[which], name, **changes)
    torch.manual_seed(0)
    options = world.options(group="D4")
    policy = EquivariantDiffusionPolicy(options, layouts["obs"], layouts["act"])
    # At initialisation outputs are small against what the noise could do: scale them up.
    policy.denoiser.project.weight.mul_(5)
    policy.freeze()
    right = {"obs_layout": world.obs_layout, "act_layout": world.act_layout}
    error = decode_error(policy, world, policy.group, torch.float32, **right)
    assert error > 1e-2
    # The very same measure vanishes for the layout that the policy believes.
    assert decode_error(policy, world, policy.group, torch.float32) <= 1e-5


def test_a_per_axis_bound_shows(trained, world, monkeypatch):
    policy = trained(group="C8")
    per_axis = "symsteer.policies.contract.clip_blocks"
    monkeypatch.setattr(per_axis, lambda x, layout, r: x.clamp(-r, r))
    assert decode_error(policy, world, policy.group, torch.float32) > 1e-2


@pytest.mark.parametrize("which", ["obs", "act"])
@pytest.mark.parametrize("statistic", ["scale", "offset"])
def test_per_dimension_statistics_show(trained, world, which, statistic):
    policy = trained(group="C8")
    normalizer = getattr(policy, f"{which}_normalizer")
    name = "goal" if which == "obs" else "xy"
    before = getattr(normalizer, statistic)
    broken = before.clone()
    broken[normalizer.layout.slice(name)] += torch.tensor([0.3, 0.0])
    setattr(normalizer, statistic, broken)
    try:
        assert decode_error(policy, world, policy.group, torch.float32) > 1e-2
    finally:
        setattr(normalizer, statistic, before)


@pytest.mark.parametrize("network", ["mlp", "unet"])
def test_expanded_layers_equal_the_originals(trained, network, world):
    policy = trained(group="D4", network=network)
    policy.double()
    try:
        obs = policy.normalized_observation(world.observations(4).double())
        x = torch.randn(4, policy.horizon, 7, dtype=torch.float64, requires_grad=True)
        fast = policy.denoiser.expanded()
        time = policy.denoiser.encode_time(torch.tensor([7]))
        slow_context = policy.denoiser.encode(obs)
        assert torch.allclose(fast.encode(obs), slow_context, atol=1e-12)
        slow, quick = (net(x, slow_context, time) for net in (policy.denoiser, fast))
        assert torch.allclose(slow, quick, atol=1e-12)
        slow, quick = (torch.autograd.grad(out.square().sum(), x)[0] for out in (slow, quick))
        assert torch.allclose(slow, quick, atol=1e-12)
    finally:
        policy.float()


def test_new_weights_reach_decode(world):
    """The matrices cached for decoding follow the weights."""
    policy = world.untrained(group="C4")
    obs, noise = world.observations(2), torch.randn(2, policy.horizon, 7)
    before = policy.decode(obs, noise)
    other = world.untrained(group="C4")
    torch.manual_seed(3)
    for parameter in other.parameters():
        parameter.normal_(std=0.1)
    policy.load_state_dict(other.state_dict())
    after = policy.decode(obs, noise)
    assert not torch.allclose(before, after, atol=1e-3)
    assert torch.equal(after, other.decode(obs, noise))
    with torch.no_grad():
        policy.denoiser.project.weight.mul_(3)
    policy.freeze()
    assert not torch.allclose(policy.decode(obs, noise), after, atol=1e-3)


def test_the_network_sees_its_condition_and_noise_level(trained, world):
    policy = trained(group="C8")
    noise = torch.randn(8, policy.horizon, 7, generator=torch.Generator().manual_seed(0))
    obs = world.observations(8)
    assert (policy.decode(obs, noise) - policy.decode(obs.flip(0), noise)).abs().max() > 0.1
    assert (policy.decode(obs, noise) - policy.decode(obs, noise.flip(0))).abs().max() > 0.01
    times = policy.denoiser.encode_time(torch.tensor([0, 50, 99]))
    assert (times[0] - times[1]).abs().max() > 1e-2


def test_angles_of_a_normalizer_fit_do_not_matter(world):
    """Statistics of turned demonstrations are those of the demonstrations (vectors only)."""
    obs = torch.cat([o for o, _ in world.episodes(4)]).double()
    angle = math.radians(37)
    first = Normalizer.fit(world.obs_layout, obs)
    second = Normalizer.fit(world.obs_layout, world.obs_layout.transform(obs, angle))
    assert torch.allclose(first.scale, second.scale, atol=1e-6)
    assert torch.allclose(first.offset, second.offset, atol=1e-6)
