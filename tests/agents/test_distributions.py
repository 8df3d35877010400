"""The radial squash: density, numerical safety, commuting with the group."""

import math

import pytest
import torch

from symsteer.agents.distributions import SMALL, SquashedGaussian
from symsteer.policies.geometry import Field, Group, Layout

LAYOUT = Layout([Field("xy", 1), Field("z", 0), Field("tilt", 1, odd=True), Field("rod", 2)])
# The same seven numbers, all as scalars: a separate tanh for each number.
PER_AXIS = Layout([Field("numbers", 0, LAYOUT.dim)])
GROUPS = ["C8", "C4", "D4", "D8", "C3"]


def parameters(batch, dtype=torch.float64, seed=0, layout=LAYOUT):
    g = torch.Generator().manual_seed(seed)
    draw = torch.randn(batch, 2 * layout.dim + len(layout.blocks), generator=g).to(dtype)
    return draw.split([layout.dim, len(layout.blocks), layout.dim], dim=1)


@pytest.mark.parametrize("size", [1e-9, 1e-3, 0.99 * SMALL**0.5, 1.01 * SMALL**0.5, 0.3, 1.0, 6.0])
def test_log_density_is_that_of_the_jacobian(size):
    gaussian = SquashedGaussian(LAYOUT, 1.5).double()
    mean, log_scale, eps = parameters(4)
    mean = size * mean / mean.norm(dim=1, keepdim=True)
    log_scale = math.log(0.3 * size) + 0.2 * log_scale
    _, log_prob = gaussian.sample(mean, log_scale, eps)
    for i in range(4):
        jacobian = torch.autograd.functional.jacobian(
            lambda e, i=i: gaussian.sample(mean[i], log_scale[i], e)[0], eps[i]
        )
        standard = -0.5 * eps[i].square().sum() - 0.5 * LAYOUT.dim * math.log(2 * math.pi)
        expected = standard - torch.linalg.slogdet(jacobian).logabsdet
        assert log_prob[i].item() == pytest.approx(expected.item(), rel=1e-9, abs=1e-8)


@pytest.mark.parametrize("size", [1e-3, 0.99 * SMALL**0.5, 1.01 * SMALL**0.5, 0.3, 1.0, 5.0])
def test_gradients_are_those_of_finite_differences(size):
    gaussian = SquashedGaussian(LAYOUT, 1.5).double()
    mean, log_scale, eps = parameters(4)
    mean, log_scale = size * mean, 0.2 * log_scale + math.log(0.3 * size)
    inputs = [x.requires_grad_() for x in (mean, log_scale, eps)]
    assert torch.autograd.gradcheck(gaussian.sample, inputs, eps=1e-7, atol=1e-5)


@pytest.mark.parametrize("size", [0.0, 1e-8, 1e-3, 1.0, 30.0, 3e3])
def test_values_and_gradients_stay_finite(size):
    gaussian = SquashedGaussian(LAYOUT, 1.5)
    u = torch.full((1, LAYOUT.dim), size, requires_grad=True)
    log_scale = torch.zeros(1, gaussian.blocks, requires_grad=True)
    noise, log_prob = gaussian.sample(u, log_scale, torch.zeros(1, LAYOUT.dim))
    (noise.sum() + log_prob.sum()).backward()
    assert torch.isfinite(log_prob).all()
    assert torch.isfinite(u.grad).all()
    assert torch.isfinite(log_scale.grad).all()
    assert all(noise[0, block].norm() <= 1.5 * (1 + 1e-6) for block in LAYOUT.blocks)


def rotated(layout, name, dtype, gaussian):
    """Largest error over the group of noise, mode and log-density, relative to their size."""
    mean, log_scale, eps = parameters(32, dtype)
    noise, log_prob = gaussian.sample(mean, log_scale, eps)
    mode = gaussian.squash(mean)
    errors = []
    for angle, reflect in Group.parse(name).elements:

        def turn(x, angle=angle, reflect=reflect):
            return layout.transform(x, angle, reflect)

        noise_g, log_prob_g = gaussian.sample(turn(mean), log_scale, turn(eps))
        errors += [
            (noise_g - turn(noise)).norm() / noise.norm(),
            (log_prob_g - log_prob).norm() / log_prob.norm(),
            (gaussian.squash(turn(mean)) - turn(mode)).norm() / mode.norm(),
        ]
    return max(error.item() for error in errors)


@pytest.mark.parametrize(("dtype", "limit"), [(torch.float32, 1e-5), (torch.float64, 1e-10)])
@pytest.mark.parametrize("name", GROUPS)
def test_samples_turn_with_mean_and_noise(name, dtype, limit):
    assert rotated(LAYOUT, name, dtype, SquashedGaussian(LAYOUT, 1.5).to(dtype)) < limit


class PerAxis(SquashedGaussian):
    """A wrong squash: one scale per block, but a separate tanh for each number."""

    def __init__(self):
        super().__init__(LAYOUT, 1.5)
        self.inner = SquashedGaussian(PER_AXIS, 1.5)

    def sample(self, mean, log_scale, eps):
        return self.inner.sample(mean, self.spread(log_scale), eps)

    def squash(self, u):
        return self.inner.squash(u)


def test_a_tanh_per_axis_breaks_c8_and_keeps_c4():
    assert rotated(LAYOUT, "C8", torch.float64, PerAxis().double()) > 1e-2
    assert rotated(LAYOUT, "C4", torch.float64, PerAxis().double()) < 1e-10


def test_a_scale_per_number_breaks_even_c4():
    gaussian = SquashedGaussian(LAYOUT, 1.5).double()
    mean, _, eps = parameters(32)
    scale = torch.linspace(0.5, 2.0, LAYOUT.dim, dtype=torch.float64)
    log_scale = torch.zeros(32, gaussian.blocks, dtype=torch.float64)
    quarter = math.pi / 2
    straight = LAYOUT.transform(gaussian.sample(mean, log_scale, scale * eps)[0], quarter)
    turned = gaussian.sample(
        LAYOUT.transform(mean, quarter), log_scale, scale * LAYOUT.transform(eps, quarter)
    )[0]
    assert (straight - turned).norm() / straight.norm() > 1e-2


def test_saturation():
    gaussian = SquashedGaussian(LAYOUT, 1.5)
    noise = torch.zeros(LAYOUT.dim)
    noise[LAYOUT.slice("tilt")] = torch.tensor([1.2, 0.9])  # norm 1.5
    noise[LAYOUT.slice("z")] = 1.3
    assert gaussian.saturated(noise).tolist() == [False, False, True, False]
