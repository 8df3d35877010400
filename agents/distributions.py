"""A squashed Gaussian that commutes with the group: each irrep block is squashed into a ball.

Noise ``w`` splits into irrep blocks (scalars and planar vectors). Each block is

    u = mean + scale * eps,   eps ~ N(0, I),   one scale per block,
    w = bound * tanh(|u|) * u / |u|,

so a rotation of ``mean`` and ``eps`` rotates ``w``, and the density is invariant. The usual tanh of
each number commutes with quarter turns only. For scalars both are the same. The log-determinant of
one block is

    log |dw/du| = size * log(bound) + log sech^2(|u|) + (size - 1) * log(tanh(|u|) / |u|).

Squashed Gaussians: Haarnoja et al., arXiv 1812.05905, appendix C; the radial form is ours.
"""

from __future__ import annotations

import math
from typing import Any

import torch
import torch.nn.functional as F
from torch import nn

from symsteer.policies.geometry import Field, Layout

SMALL = 1e-4
"""Below this |u|^2, the slope of tanh(|u|)/|u| is evaluated by its power series in |u|^2, whose
first dropped term is below 1e-14."""

LEAST = 1e-30
"""|u|^2 is taken as at least this, so that nothing is divided by 0."""

LOG_SCALE_MIN, LOG_SCALE_MAX = -5.0, 1.0

INITIAL_SCALE = 0.5
"""The scale where an actor's output is 0."""


class SquashedGaussian(nn.Module):
    """The distribution family of one noise layout; its methods take the parameters.

    Args:
        layout: geometry of the flattened noise, ``dim`` numbers in ``blocks`` irrep blocks.
        bound: largest norm of a block, > 0.
    """

    index: torch.Tensor
    sizes: torch.Tensor
    membership: torch.Tensor

    def __init__(self, layout: Layout, bound: float):
        super().__init__()
        self.bound = bound
        self.dim, self.blocks = layout.dim, len(layout.blocks)
        # The means, then one invariant number per irrep block.
        scales = Field("log_scales", 0, self.blocks)
        self.parameter_layout = Layout([*layout.fields, scales])
        membership = F.one_hot(layout.block_index, self.blocks).to(torch.get_default_dtype())
        self.register_buffer("index", layout.block_index.clone(), persistent=False)
        self.register_buffer("membership", membership, persistent=False)  # [dim, blocks]
        self.register_buffer("sizes", membership.sum(0), persistent=False)
        # -log of the constant factor of the density.
        self.constant = self.dim * (0.5 * math.log(2 * math.pi) + math.log(bound))

    def parameters_of(self, output: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean ``[..., dim]`` and log-scale ``[..., blocks]`` from an actor's output.

        The log-scale is a sigmoid, so that its gradient never vanishes at a clamp.
        """
        mean, raw = output.split([self.dim, self.blocks], dim=-1)
        extent = LOG_SCALE_MAX - LOG_SCALE_MIN
        share = (math.log(INITIAL_SCALE) - LOG_SCALE_MIN) / extent
        start = math.log(share / (1 - share))
        return mean, LOG_SCALE_MIN + extent * (raw + start).sigmoid()

    def sample(
        self, mean: torch.Tensor, log_scale: torch.Tensor, eps: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Reparametrised sample and its log-density.

        Args:
            mean: ``[..., dim]``.
            log_scale: ``[..., blocks]``.
            eps: standard normal numbers, ``[..., dim]``.

        Returns:
            Noise ``[..., dim]`` and log-probability ``[...]``, both differentiable.
        """
        noise, log_volume = self._squash(torch.addcmul(mean, self.spread(log_scale.exp()), eps))
        known = eps.square().sum(-1).mul_(-0.5).sub_(self.constant)
        return noise, known - log_scale @ self.sizes - log_volume

    def squash(self, u: torch.Tensor) -> torch.Tensor:
        """``u [..., dim]`` with every block shortened into the ball of radius ``bound``."""
        return self._squash(u)[0]

    def saturated(self, noise: torch.Tensor, share: float = 0.95) -> torch.Tensor:
        """Blocks with a norm above ``share`` of the bound, ``[..., blocks]`` bool."""
        return noise.square() @ self.membership > (share * self.bound) ** 2

    def spread(self, per_block: torch.Tensor) -> torch.Tensor:
        """``[..., blocks]`` to ``[..., dim]``: each number gets its block's value."""
        return per_block.index_select(-1, self.index)

    def _squash(self, u: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """``w = bound tanh(|u|) u/|u|`` per block, and the summed log-determinant for bound 1."""
        return RadialTanh.apply(u, self.bound, self.membership, self.index, self.sizes)


class RadialTanh(torch.autograd.Function):
    """``bound tanh(|u|) u/|u|`` per block, with the derivative in closed form.

    With s = |u|^2 of a block of n numbers and the ratio ``p(s) = tanh(|u|) / |u|``:

        w = bound p u,   log det = log sech^2 |u| + (n - 1) log p   (for bound 1),
        dp/ds = (sech^2 |u| - p) / (2 s),   d log det / ds = -p + (n - 1) (dp/ds) / p.

    As functions of s (not of |u|) they are smooth at zero. The derivative is written out because
    automatic differentiation of the same formulas took a sixth of an update's time.
    """

    @staticmethod
    def forward(
        ctx: Any,
        u: torch.Tensor,
        bound: float,
        membership: torch.Tensor,
        index: torch.Tensor,
        sizes: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """``u [..., dim]`` to ``w [..., dim]`` and the log-determinant ``[...]`` for bound 1."""
        steep = any(ctx.needs_input_grad)
        noise, log_volume, *slopes = squash(u, bound, membership, index, sizes, steep)
        if steep:
            ctx.save_for_backward(u, membership, index, sizes, *slopes)
            ctx.bound = bound
        return noise, log_volume

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, *tuple[None, ...]]:
        """Chain rule through s."""
        grad_w, grad_volume = gradients
        gradient = squash_gradient(grad_w, grad_volume, ctx.bound, *ctx.saved_tensors)
        return gradient, None, None, None, None


def squash(
    u: torch.Tensor,
    bound: float,
    membership: torch.Tensor,
    index: torch.Tensor,
    sizes: torch.Tensor,
    steep: bool,
) -> tuple[torch.Tensor, ...]:
    """``w``, the log-determinant for bound 1, and if ``steep`` p and dp/ds."""
    s = (u.square() @ membership).clamp_min_(LEAST)
    r = s.sqrt()
    tanh = r.tanh()
    ratio = tanh / r
    # sech^2 = 4 / (e^r + e^-r)^2, in a form without overflow or log 0 at large radii.
    half = r + F.softplus(-2 * r)
    log_volume = (ratio.log() @ (sizes - 1)).add_(2 * math.log(2) * len(sizes))
    log_volume.sub_(half.sum(-1), alpha=2)
    noise = u * (bound * ratio).index_select(-1, index)
    if not steep:
        return noise, log_volume
    series = -1 / 3 + s * (4 / 15 - s * (17 / 105 - s * 248 / 2835))
    slope = torch.where(s < SMALL, series, (1 - tanh * tanh - ratio) / (2 * s))
    return noise, log_volume, ratio, slope


def squash_gradient(
    grad_w: torch.Tensor,
    grad_volume: torch.Tensor,
    bound: float,
    u: torch.Tensor,
    membership: torch.Tensor,
    index: torch.Tensor,
    sizes: torch.Tensor,
    ratio: torch.Tensor,
    slope: torch.Tensor,
) -> torch.Tensor:
    """du = ``bound p dw`` + ``2 u`` times the gradient of s."""
    to_s = (slope * bound).mul_((grad_w * u) @ membership)
    of_volume = (slope / ratio).mul_(sizes - 1).sub_(ratio)
    to_s.addcmul_(grad_volume.unsqueeze(-1), of_volume).mul_(2)
    ratio, to_s = (x.index_select(-1, index) for x in (bound * ratio, to_s))
    return torch.addcmul(grad_w * ratio, u, to_s)
