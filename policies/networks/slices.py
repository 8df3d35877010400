"""Networks for one slice of a chunk: a residual MLP and a temporal U-Net.

They have no symmetry of their own: :class:`symsteer.policies.symmetry.lifted.LiftedDenoiser` runs
the same network on every group element's slice. Both take the chunk's features and conditioning
numbers, which scale and shift the hidden features (FiLM, arXiv 1709.07871). The U-Net follows the
conditional one of Diffusion Policy (arXiv 2303.04137), two levels deep.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import nn
from torch.nn import functional

from symsteer.errors import UserError


class ResidualMLP(nn.Module):
    """Residual blocks on the features of the whole chunk.

    h <- h + V silu((1 + scale) U norm(h) + shift), ``depth`` times.

    Scale and shift are sums of what ``context`` and ``time`` say. They are not added up beforehand:
    for each noise level that would write and read an array as large as ``context``. For the same
    reason hidden features are overwritten; autograd copies what it needs.

    Shapes: ``h [B, slices, width]``, ``context [B, slices, condition_dim]``, ``time [B or 1, 1,
    condition_dim]`` -> ``[B, slices, width]``.
    """

    def __init__(self, width: int, depth: int):
        super().__init__()
        self.width = width
        self.condition_dim = 2 * width * depth
        self.norms = nn.ModuleList(nn.LayerNorm(width) for _ in range(depth))
        self.inner = nn.ModuleList(nn.Linear(width, width) for _ in range(depth))
        self.outer = nn.ModuleList(nn.Linear(width, width) for _ in range(depth))
        self.out_norm = nn.LayerNorm(width)

    def forward(self, h: torch.Tensor, context: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
        films = (part.split(self.width, dim=-1) for part in (context, time))
        pairs = iter(zip(*films, strict=True))
        for norm, inner, outer in zip(self.norms, self.inner, self.outer, strict=True):
            (scale, time_scale), (shift, time_shift) = next(pairs), next(pairs)
            u = inner(norm(h))
            u = torch.addcmul(time_shift, u, 1 + time_scale).add_(shift).addcmul_(u, scale)
            h = outer(functional.silu(u, inplace=True)).add_(h)
        return functional.silu(self.out_norm(h), inplace=True)


class FixedResidualMLP(nn.Module):
    """A trained :class:`ResidualMLP` for decoding: the same numbers in less time.

    Slices are the rows of one matrix, and torch's kernels are called without their modules: beside
    products of this size the calls of modules take time, too. All rows have one noise level.

    Shapes: ``h [B, slices, width]``, ``context [B, slices, condition_dim]``, ``time [1, 1,
    condition_dim]`` -> ``[B, slices, width]``.
    """

    def __init__(self, network: ResidualMLP):
        super().__init__()
        self.width = network.width
        blocks = zip(network.norms, network.inner, network.outer, strict=True)
        self.blocks = [[_affine(layer) for layer in block] for block in blocks]
        self.out_norm = _affine(network.out_norm)
        # A noise level's scales are relative to 1, its shifts to 0.
        ones = torch.ones_like(network.out_norm.weight)
        self.neutral = torch.cat([ones, torch.zeros_like(ones)]).repeat(len(self.blocks))

    def forward(self, h: torch.Tensor, context: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
        width, shape = self.width, h.shape
        seen = context.flatten(0, 1).split(width, dim=-1)
        level = (time.flatten() + self.neutral).split(width)
        h = h.reshape(-1, width)
        for i, (norm, (inner, inner_bias), (outer, outer_bias)) in enumerate(self.blocks):
            scale, shift = 2 * i, 2 * i + 1
            u = torch.addmm(inner_bias, torch.layer_norm(h, (width,), *norm), inner.t())
            film = torch.addcmul(level[shift], u, level[scale])
            film.add_(seen[shift]).addcmul_(u, seen[scale])
            h = torch.addmm(outer_bias, functional.silu(film, inplace=True), outer.t()).add_(h)
        h = torch.layer_norm(h, (width,), *self.out_norm)
        return functional.silu(h, inplace=True).view(shape)


def _affine(layer: Any) -> tuple[torch.Tensor, torch.Tensor]:
    """Weight and bias of a layer, outside of its module."""
    return layer.weight.detach(), layer.bias.detach()


class _TemporalBlock(nn.Module):
    """Two convolutions over time with FiLM after the first; ``[N, in, T] -> [N, out, T]``."""

    def __init__(self, in_channels: int, out_channels: int):
        super().__init__()
        self.condition_dim = 2 * out_channels
        groups = _norm_groups(out_channels)
        self.first = nn.Conv1d(in_channels, out_channels, 3, padding=1)
        self.first_norm = nn.GroupNorm(groups, out_channels)
        self.second = nn.Conv1d(out_channels, out_channels, 3, padding=1)
        self.second_norm = nn.GroupNorm(groups, out_channels)
        self.skip = (
            nn.Identity()
            if in_channels == out_channels
            else nn.Conv1d(in_channels, out_channels, 1)
        )

    def forward(self, h: torch.Tensor, film: torch.Tensor) -> torch.Tensor:
        scale, shift = film.unsqueeze(-1).chunk(2, dim=1)
        u = self.first_norm(self.first(h))
        u = functional.silu(torch.addcmul(u + shift, u, scale))
        return self.skip(h) + functional.silu(self.second_norm(self.second(u)))


class TemporalUNet(nn.Module):
    """A conditional 1-D U-Net over the steps of the chunk: full rate, half rate, full rate.

    Shapes: ``h [N, T, width]``, ``condition [N, condition_dim]`` -> ``[N, T, width]``; T even.
    """

    def __init__(self, width: int):
        super().__init__()
        self.down = _TemporalBlock(width, width)
        self.shrink = nn.Conv1d(width, width, 4, stride=2, padding=1)
        self.middle = nn.ModuleList(
            [_TemporalBlock(width, 2 * width), _TemporalBlock(2 * width, 2 * width)]
        )
        self.grow = nn.ConvTranspose1d(2 * width, width, 4, stride=2, padding=1)
        self.up = _TemporalBlock(2 * width, width)
        self._film_sizes = [block.condition_dim for block in (self.down, *self.middle, self.up)]
        self.condition_dim = sum(self._film_sizes)

    def forward(self, h: torch.Tensor, condition: torch.Tensor) -> torch.Tensor:
        if h.shape[1] % 2:
            raise UserError(f"the U-Net halves the chunk: choose an even horizon, not {h.shape[1]}")
        films = condition.split(self._film_sizes, dim=-1)
        full = self.down(h.transpose(1, 2), films[0])
        half = self.shrink(full)
        for block, film in zip(self.middle, films[1:-1], strict=True):
            half = block(half, film)
        out = self.up(torch.cat([self.grow(half), full], dim=1), films[-1])
        return out.transpose(1, 2)


def _norm_groups(channels: int) -> int:
    """The largest divisor of ``channels`` up to 8."""
    return next(n for n in range(8, 0, -1) if channels % n == 0)
