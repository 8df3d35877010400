"""Targets that are means over the orbit of a demonstrated pair (Orbit Diffusion, arXiv 2502.09890).

Under a symmetry of the data, a noisy pair of observation and chunk may come from any turned copy
of the demonstrated pair. Denoising towards the mean of the copies, each weighted by the probability
that the noisy pair comes from it,

    w_g ~ exp(-|o' - g o|^2 / (2 h^2) - |x_t - k_t g x_0|^2 / (2 s_t^2)),

has the same expected gradient as denoising towards the pair's own chunk, over data that are
symmetric, and less variance. A condition that is known exactly leaves one copy, the pair itself:
here the network sees observations o' with noise of deviation h (our choice; the paper has no such
condition).
"""

from __future__ import annotations

import torch

from symsteer.policies.geometry import Group, Layout

Noisy = tuple[torch.Tensor, torch.Tensor, torch.Tensor | float, torch.Tensor | float]
"""Clean rows ``x [B, ..., dim]``, noisy ones of the same shape, and the factors: the noisy rows are
``keep * x + spread * noise``."""


def orbit_targets(
    pairs: tuple[Noisy, Noisy], layouts: tuple[Layout, Layout], group: Group
) -> torch.Tensor:
    """The mean of the second row's turned copies, given the noisy ones.

    Args:
        pairs: observations and chunks.
        layouts: of their last axes.
        group: a finite group, a symmetry of the data.

    Returns:
        ``[B, ...]``, as the clean rows of the second pair.
    """
    copies = [
        _copies(clean, layout, group) for (clean, *_), layout in zip(pairs, layouts, strict=True)
    ]
    distances = [
        ((noisy - keep * turned) / spread).square().flatten(2).sum(-1)
        for (_, noisy, keep, spread), turned in zip(pairs, copies, strict=True)
    ]
    weights = torch.softmax(-(distances[0] + distances[1]) / 2, dim=0)
    return torch.einsum("gb,gb...->b...", weights, copies[1])


def _copies(x: torch.Tensor, layout: Layout, group: Group) -> torch.Tensor:
    """``[order, B, ..., dim]``."""
    rho = group.representation(layout, x.dtype, x.device)
    return torch.einsum("gij,b...j->gb...i", rho, x)
