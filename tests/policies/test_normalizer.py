"""Normaliser and block-wise bounds: values, exact commutation, guards."""

import math

import pytest
import torch

from symsteer.errors import UserError
from symsteer.policies.geometry import Field, Layout
from symsteer.policies.normalizer import MINIMUM_RANGE, Normalizer, clip_blocks

LAYOUT = Layout(
    [Field("xy", 1, 2), Field("z", 0), Field("yaw", 0, odd=True), Field("rod", 2, odd=True)]
)
ELEMENTS = [(2 * math.pi * i / 8, flip) for i in (1, 2, 5) for flip in (False, True)]


def data(count=200):
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(count, LAYOUT.dim, generator=generator, dtype=torch.float64)
    return x * torch.tensor([1.0, 3, 0.5, 0.5, 2, 1, 1, 4]) + torch.tensor(
        [2.0, 0, 0, -1, 5, 0.3, 1, 0]
    )


def test_statistics():
    x = data()
    fitted = Normalizer.fit(LAYOUT, x)
    y = fitted.normalize(x)
    z, yaw = LAYOUT.slice("z"), LAYOUT.slice("yaw")
    assert [end.item() for end in y[:, z].aminmax()] == pytest.approx([-1, 1])
    assert fitted.scale[yaw].item() == pytest.approx(float(x[:, yaw].abs().max()))
    assert fitted.deviation[z].item() == pytest.approx(float(x[:, z].std(correction=0)))
    for block in LAYOUT.blocks:
        if block.stop - block.start == 2:
            assert fitted.scale[block][0] == fitted.scale[block][1]
            assert y[:, block].norm(dim=-1).max().item() == pytest.approx(1.0, abs=1e-6)
            size = float(x[:, block].square().mean().sqrt())
            assert fitted.deviation[block].tolist() == pytest.approx([size] * 2)
    assert (fitted.offset[~LAYOUT.invariant_mask(reflections=True)] == 0).all()
    # Blocks of one field keep scales of their own.
    assert fitted.scale[0] != fitted.scale[2]
    assert torch.allclose(fitted.unnormalize(y), x, atol=1e-12)


@pytest.mark.parametrize("element", [*ELEMENTS, (0.3, False), (1.7, True)])
def test_commutes_with_rotations_and_reflections(element):
    x, turned = data(), LAYOUT.transform(data(), *element)
    fitted = Normalizer.fit(LAYOUT, x).double()
    assert torch.allclose(Normalizer.fit(LAYOUT, turned).scale.double(), fitted.scale, atol=1e-5)
    for function in (fitted.normalize, lambda v: clip_blocks(v, LAYOUT, 1.0)):
        expected = LAYOUT.transform(function(x), *element)
        assert torch.allclose(function(turned), expected, atol=1e-13)


def test_constant_fields_keep_their_unit():
    x = data()
    x[:, LAYOUT.slice("z")] = 7.0
    x[:, LAYOUT.slice("rod")] = 1e-4 * torch.randn(len(x), 2, dtype=torch.float64)
    fitted = Normalizer.fit(LAYOUT, x)
    assert fitted.scale[LAYOUT.slice("z")].item() == 1.0
    assert fitted.offset[LAYOUT.slice("z")].item() == 7.0
    assert fitted.scale[LAYOUT.slice("rod")].tolist() == [1.0, 1.0]
    assert fitted.normalize(x)[:, LAYOUT.slice("rod")].abs().max() < MINIMUM_RANGE


def test_clip_blocks_bounds_norms_and_leaves_the_rest_alone():
    x = data().float()
    y = clip_blocks(x, LAYOUT, 1.5)
    for block in LAYOUT.blocks:
        before, after = x[:, block].norm(dim=-1), y[:, block].norm(dim=-1)
        assert after.max() <= 1.5 * (1 + 1e-6)
        inside = before <= 1.49
        assert torch.equal(x[inside, block], y[inside, block])
        cosine = (x[:, block] * y[:, block]).sum(-1) / (before * after)
        assert torch.allclose(cosine, torch.ones(()), atol=1e-5)
    assert y.abs().max() <= 1.5
    assert torch.equal(clip_blocks(torch.zeros(1, LAYOUT.dim), LAYOUT, 1.0), torch.zeros(1, 8))


def test_the_gradient_of_clip_blocks_is_finite_everywhere():
    """An action that a correction brought to exactly 0 made all parameters NaN."""
    x = torch.stack([torch.zeros(8), torch.full((8,), 0.1), torch.full((8,), 5.0)])
    x.requires_grad_()
    clip_blocks(x, LAYOUT, 1.0).sum().backward()
    assert torch.equal(x.grad[:2], torch.ones(2, 8))
    assert x.grad.isfinite().all()


@pytest.mark.parametrize(
    "bad", [torch.zeros(0, 8), torch.zeros(5, 7), torch.full((5, 8), float("nan"))]
)
def test_bad_data_raise_user_errors(bad):
    with pytest.raises(UserError):
        Normalizer.fit(LAYOUT, bad)
