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
"""Below this |u|^2, functions of |u| are evaluated by their power series in |u|^2, whose first
dropped terms are below 1e-14."""

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
        noise, log_volume = self._squash(mean + self.spread(log_scale.exp()) * eps)
        constant = 0.5 * self.dim * math.log(2 * math.pi)
        gaussian = -0.5 * eps.square().sum(-1) - log_scale @ self.sizes - constant
        return noise, gaussian - log_volume

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
        """``w = bound tanh(|u|) u/|u|`` per block and the summed log-determinant."""
        direction, log_volume = RadialTanh.apply(u, self.membership, self.index, self.sizes)
        return self.bound * direction, log_volume + self.dim * math.log(self.bound)


class RadialTanh(torch.autograd.Function):
    """``tanh(|u|) u/|u|`` per block and its log-determinant, with the derivative in closed form.

    With s = |u|^2 of a block of n numbers and the ratio ``p(s) = tanh(|u|) / |u|``:

        w = p u,   log det = log sech^2 |u| + (n - 1) log p,
        dp/ds = (sech^2 |u| - p) / (2 s),   d log det / ds = -p + (n - 1) (dp/ds) / p.

    As functions of s (not of |u|) they are smooth at zero. The derivative is written out because
    automatic differentiation of the same formulas took a sixth of an update's time.
    """

    @staticmethod
    def forward(
        ctx: Any,
        u: torch.Tensor,
        membership: torch.Tensor,
        index: torch.Tensor,
        sizes: torch.Tensor,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """``u [..., dim]`` to ``w [..., dim]`` and log-determinant ``[...]``."""
        s = u.square() @ membership
        small = s < SMALL
        r = s.sqrt()
        tanh = r.tanh()
        ratio = torch.where(small, 1 - s * (1 / 3 - s * (2 / 15 - s * 17 / 315)), tanh / r)
        # sech^2 = 4 / (e^r + e^-r)^2, in a form without overflow or log 0 at large radii.
        far = 2 * (math.log(2) - r - torch.log1p((-2 * r).exp()))
        log_sech2 = torch.where(small, -s * (1 - s * (1 / 6 - s * 2 / 45)), far)
        log_volume = (log_sech2 + (sizes - 1) * ratio.log()).sum(-1)
        if any(ctx.needs_input_grad):
            series = -1 / 3 + s * (4 / 15 - s * (17 / 105 - s * 248 / 2835))
            slope = torch.where(small, series, (1 - tanh * tanh - ratio) / (2 * s))
            ctx.save_for_backward(u, membership, index, ratio, slope, sizes)
        return u * ratio.index_select(-1, index), log_volume

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, None, None, None]:
        """Chain rule through s: du = ``p dw`` + ``2 u`` times the gradient of s."""
        grad_w, grad_volume = gradients
        u, membership, index, ratio, slope, sizes = ctx.saved_tensors
        to_s = slope * ((grad_w * u) @ membership)
        to_s = to_s + grad_volume.unsqueeze(-1) * ((sizes - 1) * slope / ratio - ratio)
        spread = torch.cat([ratio, 2 * to_s], dim=-1)
        spread = spread.unflatten(-1, (2, -1)).index_select(-1, index)
        ratio, to_s = spread.unbind(-2)
        return grad_w * ratio + u * to_s, None, None, None
