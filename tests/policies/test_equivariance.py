"""decode(g s, g w) = g decode(s, w): exactly, for every element; and not for wrong layouts."""

from dataclasses import replace

import pytest
import torch

from symsteer.policies.geometry import Group, Layout
from symsteer.policies.networks.equivariant import RegularLinear
from tests.marks import long_except
from tests.policies.conftest import (
    ACT,
    OBS,
    as_type,
    assert_exact,
    decode_error,
    noises,
    observations,
    untrained,
)

IRREPS = {"channels": 8, "width": 8, "depth": 1, "zero_output": False}
WAYS = {
    **{name: {"group": name} for name in ("C4", "C8", "D4")},
    **{f"{name}, U-Net": {"group": name, "network": "unet"} for name in ("C4", "C8", "D4")},
    "frame-averaged": {"name": "frame-averaged", "group": "D4"},
    "frame-averaged, U-Net": {"name": "frame-averaged", "group": "C4", "network": "unet"},
    "canonical": {"name": "canonical"},
    "canonical, anchor": {"name": "canonical", "anchor": "tcp"},
    "escnn": {"name": "escnn", "group": "C8"},
    "escnn, D4": {"name": "escnn", "group": "D4"},
    "so2": {"name": "so2", **IRREPS},
    "spherical": {"name": "spherical", **IRREPS},
    "relative actions": {"group": "D4", "action_frame": "goal"},
    "averaged, relative actions": {"name": "frame-averaged", "action_frame": "tcp"},
    "flow": {"group": "C8", "process": "flow", "prediction": "velocity"},
    "epsilon": {"group": "C8", "prediction": "epsilon"},
}


@pytest.mark.parametrize("way", long_except(list(WAYS), *(w for w in WAYS if w != "escnn, D4")))
def test_every_way_to_be_symmetric_is_exact(trained, way):
    """Before and after training."""
    # sqrt(a_t) = 5e-4 at the first level divides the rounding errors.
    tolerance = 5e-3 if way == "epsilon" else 1e-5
    for policy in (untrained(**WAYS[way]), trained(**WAYS[way], steps=15)):
        assert policy.group.order > 1
        assert_exact(policy, tolerance=tolerance)
        if policy.name in ("canonical", "so2", "spherical"):
            assert_exact(policy, Group.parse("C5"))


def test_the_frame_of_a_chunk_is_needed(trained, monkeypatch):
    """Relative actions in the world's frame would not be symmetric."""
    policy = trained(group="D4", action_frame="goal", steps=15)
    monkeypatch.setattr(policy.frame, "leave", lambda chunk, angle: chunk)
    assert decode_error(policy) > 1e-2


def test_bounds_are_active_in_these_tests(trained):
    """Equivariance of bounds means nothing where nothing is bounded."""
    actions = trained(group="C8").decode(1.5 * observations(16), 1.5 * noises(16))
    norms = actions[..., ACT.slice("xy")].norm(dim=-1)
    assert (norms > 0.999).float().mean() > 0.1
    assert norms.max() <= 1 + 1e-6
    assert actions.abs().max() <= 1


def test_other_angles_are_not_symmetries(trained):
    """The group is all that is built in; so the error of other angles is not zero."""
    assert decode_error(trained(group="C8"), Group.parse("C5")) > 1e-3


def changed(layout, name, **changes):
    return Layout([replace(f, **changes) if f.name == name else f for f in layout.fields])


def loud(*layouts, **fields):
    """Untrained, with large outputs: at first they are small against what the noise could do."""
    policy = untrained(layouts=layouts, group="D4", **fields)
    policy.denoiser.project.weight.mul_(5)
    return policy.freeze()


def test_a_frame_may_be_an_odd_vector():
    """Columns of a mirrored rotation change sign; the frame then turns by half a turn."""
    policy = loud(
        changed(changed(OBS, "goal", odd=True), "twist", odd=False), ACT, action_frame="goal"
    )
    assert decode_error(policy) <= 1e-5
    assert decode_error(policy, layouts=(OBS, ACT)) > 1e-2


WRONG_LAYOUTS = {
    "observation's rod turns twice as fast": ("obs", "rod", {"frequency": 1}),
    "observation's goal is a vector": ("obs", "goal", {"frequency": 0, "multiplicity": 2}),
    "action's tilt turns once": ("act", "tilt", {"frequency": 2}),
    "action's xy is a vector": ("act", "xy", {"frequency": 0, "multiplicity": 2}),
    "action's yaw is odd": ("act", "yaw", {"odd": False}),
    "action's tilt is odd": ("act", "tilt", {"odd": False}),
}


@pytest.mark.parametrize("mistake", WRONG_LAYOUTS)
def test_a_wrong_layout_shows(mistake):
    """The policy believes one layout; the world turns by the right one."""
    which, name, changes = WRONG_LAYOUTS[mistake]
    layouts = {"obs": OBS, "act": ACT}
    layouts[which] = changed(layouts[which], name, **changes)
    policy = loud(*layouts.values())
    assert decode_error(policy, layouts=(OBS, ACT)) > 1e-2
    # The very same measure vanishes for the layout that the policy believes.
    assert decode_error(policy) <= 1e-5


def test_a_per_axis_bound_shows(trained, monkeypatch):
    per_axis = "symsteer.policies.contract.clip_blocks"
    monkeypatch.setattr(per_axis, lambda x, layout, r: x.clamp(-r, r))
    assert decode_error(trained(group="C8")) > 1e-2


@pytest.mark.parametrize(("which", "name"), [("obs", "goal"), ("act", "xy")])
@pytest.mark.parametrize("statistic", ["scale", "offset"])
def test_per_dimension_statistics_show(trained, which, name, statistic, monkeypatch):
    policy = trained(group="C8")
    normalizer = getattr(policy, f"{which}_normalizer")
    broken = getattr(normalizer, statistic).clone()
    broken[normalizer.layout.slice(name)] += torch.tensor([0.3, 0.0])
    monkeypatch.setitem(normalizer._buffers, statistic, broken)
    assert decode_error(policy) > 1e-2


@pytest.mark.parametrize("network", ["mlp", "unet"])
def test_expanded_layers_equal_the_originals(network):
    policy = untrained(group="D4", network=network)
    with as_type(torch.float64, policy):
        obs = policy.normalized_observation(observations(4).double())
        x = noises(4).double().requires_grad_()
        fast = policy.denoiser.expanded()
        time = policy.denoiser.encode_time(torch.tensor([7]))
        context = policy.denoiser.encode(obs)
        assert torch.allclose(fast.encode(obs), context, atol=1e-12)
        slow, quick = (net(x, context, time) for net in (policy.denoiser, fast))
        assert torch.allclose(slow, quick, atol=1e-12)
        slow, quick = (torch.autograd.grad(out.square().sum(), x)[0] for out in (slow, quick))
        assert torch.allclose(slow, quick, atol=1e-12)


def test_new_weights_reach_decode():
    """The matrices cached for decoding follow the weights."""
    policy, other = untrained(group="C4"), untrained(group="C4")
    obs, noise = observations(2), noises(2)
    before = policy.decode(obs, noise)
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


@pytest.mark.parametrize("group", ["C4", "D4"])
def test_the_derivative_of_a_group_convolution(group):
    layer = RegularLinear(Group.parse(group), 2, 3).double()
    bias = layer.bias.detach()

    def matrix(weight):
        return layer.dense_of({"weight": weight, "bias": bias})[0]

    weight = torch.randn_like(layer.weight).requires_grad_()
    assert torch.autograd.gradcheck(matrix, weight)
