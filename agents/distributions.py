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
from typing import Any, cast

import torch
import torch.nn.functional as F
from torch import nn

from symsteer.policies.geometry import Field, Layout

SMALL = 1e-4
"""Below this |u|^2, the slope of tanh(|u|)/|u| is evaluated by its power series in |u|^2, whose
first dropped term is below 2e-9."""

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
    weights: torch.Tensor
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
        self.register_buffer("sizes", sizes := membership.sum(0), persistent=False)
        # A log-density is a sum, with these weights, of the log-scale, log p and log 2 cosh |u| of
        # each block (see `RadialSample`) and of the squares of eps, less a constant.
        weights = [-sizes, 1 - sizes, torch.full_like(sizes, 2), torch.full((self.dim,), -0.5)]
        self.register_buffer("weights", torch.cat(weights), persistent=False)
        self.constant = self.dim * (0.5 * math.log(2 * math.pi) + math.log(bound))
        self.constant += 2 * math.log(2) * self.blocks

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
        if not torch.is_grad_enabled():
            noise, log_prob, *_ = self.draw(mean, log_scale, eps)
            return noise, log_prob
        drawn = RadialSample.apply(mean, log_scale, eps, self)
        return cast(tuple[torch.Tensor, torch.Tensor], drawn)

    def squash(self, u: torch.Tensor) -> torch.Tensor:
        """``u [..., dim]`` with every block shortened into the ball of radius ``bound``."""
        _, radius = self._radius(u)
        return u * self.spread(self.bound * radius.tanh() / radius)

    def saturated(self, noise: torch.Tensor, share: float = 0.95) -> torch.Tensor:
        """Blocks with a norm above ``share`` of the bound, ``[..., blocks]`` bool."""
        return noise.square() @ self.membership > (share * self.bound) ** 2

    def spread(self, per_block: torch.Tensor) -> torch.Tensor:
        """``[..., blocks]`` to ``[..., dim]``: each number gets its block's value."""
        return per_block.index_select(-1, self.index)

    def draw(
        self, mean: torch.Tensor, log_scale: torch.Tensor, eps: torch.Tensor
    ) -> tuple[torch.Tensor, ...]:
        """Noise, log-probability, and what :class:`RadialSample` needs of the way there."""
        scale = self.spread(log_scale.exp())
        step = scale * eps
        u = mean + step
        square, radius = self._radius(u)
        tanh = radius.tanh()
        ratio = tanh / radius
        factor = self.spread(self.bound * ratio)
        noise = u * factor
        # sech |u| = 1 / cosh |u| in a form without overflow or log 0 at large radii.
        parts = [log_scale, ratio.log(), torch.logaddexp(radius, -radius), eps.square()]
        log_prob = (torch.cat(parts, -1) @ self.weights).sub_(self.constant)
        return noise, log_prob, scale, step, u, square, tanh, ratio, factor

    def _radius(self, u: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """|u|^2 and |u| of every block."""
        square = (u.square() @ self.membership).clamp_min(LEAST)
        return square, square.sqrt()


class RadialSample(torch.autograd.Function):
    """``u = mean + scale eps`` and ``w = bound tanh(|u|) u/|u|`` per block; the log-density of w.

    The derivative is in closed form. With s = |u|^2 of a block of n numbers and the ratio
    ``p(s) = tanh(|u|) / |u|``:

        w = bound p u,   log det dw/du = log sech^2 |u| + (n - 1) log p   (for bound 1),
        dp/ds = (sech^2 |u| - p) / (2 s),   d log det / ds = -p + (n - 1) (dp/ds) / p.

    As functions of s (not of |u|) they are smooth at zero. Automatic differentiation of the same
    formulas took a sixth of an update's time.
    """

    @staticmethod
    def forward(
        ctx: Any,
        mean: torch.Tensor,
        log_scale: torch.Tensor,
        eps: torch.Tensor,
        gaussian: SquashedGaussian,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """As :meth:`SquashedGaussian.sample`."""
        noise, log_prob, scale, step, u, s, tanh, ratio, factor = gaussian.draw(
            mean, log_scale, eps
        )
        fall = torch.addcmul(ratio, tanh, tanh).sub_(1).div_(s)  # -2 dp/ds
        fall = torch.where(s < SMALL, 2 / 3 - 8 / 15 * s, fall).div_(ratio)
        ctx.gaussian = gaussian
        ctx.save_for_backward(noise, eps, scale, step, u, ratio, factor, fall)
        return noise, log_prob

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Chain rule through s and u."""
        of_noise, of_density = gradients[0], gradients[1].unsqueeze(-1)
        gaussian, sizes = ctx.gaussian, ctx.gaussian.sizes
        noise, eps, scale, step, u, ratio, factor, fall = ctx.saved_tensors
        of_volume = (fall * (sizes - 1)).add_(ratio, alpha=2).mul_(of_density)
        per_block = ((of_noise * noise) @ gaussian.membership).mul_(fall).sub_(of_volume)
        of_u = torch.addcmul(of_noise * factor, u, gaussian.spread(per_block), value=-1)
        of_scale = (of_u * step) @ gaussian.membership - of_density * sizes
        of_eps = of_u * scale - of_density * eps if ctx.needs_input_grad[2] else None
        return of_u, of_scale, of_eps, None
