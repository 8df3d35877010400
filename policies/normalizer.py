"""Normalisation to unit size and bounds; both commute with planar symmetries.

Min-max statistics per dimension break rotation equivariance: the two components of a horizontal
vector get different scales and offsets. Here each scalar is scaled to [-1, 1]. Each irrep block of
frequency >= 1 has one scale and no offset. Bounds limit the norm of each block.
"""

from __future__ import annotations

import functools

import torch
from torch import nn

from symsteer.errors import UserError
from symsteer.policies.geometry import Layout

MINIMUM_RANGE = 1e-2
"""A smaller half-range counts as constant (1 cm, or 0.6 degrees in a rotation column). Division
by it would scale simulation noise to unit size."""


@functools.lru_cache(maxsize=64)
def _same_block(layout: Layout, dtype: torch.dtype, device: torch.device) -> torch.Tensor:
    index = layout.block_index
    return (index[:, None] == index[None, :]).to(dtype=dtype, device=device)


def clip_blocks(x: torch.Tensor, layout: Layout, radius: float) -> torch.Tensor:
    """Shorten every irrep block of ``x [..., dim]`` to at most ``radius``.

    Scalars are clamped to [-radius, radius]. Vectors keep their direction. Blocks within the bound
    are returned unchanged, bit for bit.
    """
    squares = (x * x) @ _same_block(layout, x.dtype, x.device)
    # The square root has no gradient at 0: clamp before it.
    shortened = x * (radius / squares.clamp_min(radius * radius).sqrt())
    # Only for components that are a few ulps outside after rounding.
    return shortened.clamp(-radius, radius)


class Normalizer(nn.Module):
    """An affine map per irrep block: normalize(x) = (x - offset) / scale.

    Args:
        layout: geometry of the vectors.
        scale: ``[dim]``, positive, equal within each block of frequency >= 1.
        offset: ``[dim]``, zero except for scalars that are invariant under reflections.
        deviation: ``[dim]``, spread of the data in data units; see :meth:`fit`.

    The state dict holds ``scale``, ``offset`` and ``deviation``.
    """

    scale: torch.Tensor
    offset: torch.Tensor
    deviation: torch.Tensor

    def __init__(
        self,
        layout: Layout,
        scale: torch.Tensor | None = None,
        offset: torch.Tensor | None = None,
        deviation: torch.Tensor | None = None,
    ):
        super().__init__()
        self.layout = layout
        self.register_buffer("scale", torch.ones(layout.dim) if scale is None else scale)
        self.register_buffer("offset", torch.zeros(layout.dim) if offset is None else offset)
        self.register_buffer(
            "deviation", torch.ones(layout.dim) if deviation is None else deviation
        )

    @classmethod
    def fit(cls, layout: Layout, data: torch.Tensor, smallest: float = MINIMUM_RANGE) -> Normalizer:
        """Statistics of ``data [..., dim]``.

        Scalars: offset = middle, scale = half the range between minimum and maximum. Odd scalars
        (they change sign under reflections): scale = largest magnitude, no offset. Vectors: scale =
        largest norm, no offset. A range below ``smallest`` gives scale 1.

        ``deviation`` of a scalar is its standard deviation. ``deviation`` of a vector is the root
        mean square of its components: the standard deviation over all rotations of the data.

        Raises:
            UserError: if the data are empty, not finite or of another width.
        """
        if data.shape[-1] != layout.dim or data.numel() == 0:
            raise UserError(
                f"the data to normalise have shape {tuple(data.shape)}; needed are one or more "
                f"rows of {layout.dim} numbers, the width of the layout"
            )
        data = data.reshape(-1, layout.dim).double()
        if not data.isfinite().all():
            raise UserError("the data to normalise hold NaN or infinite numbers; remove them")
        low, high = data.min(dim=0).values, data.max(dim=0).values
        squares = (data * data) @ _same_block(layout, data.dtype, data.device)
        radius = squares.max(dim=0).values.sqrt()
        # An offset would break the symmetry of blocks that are not invariant.
        shiftable = layout.invariant_mask(reflections=True).to(data.device)
        offset = torch.where(shiftable, (low + high) / 2, 0.0)
        scale = torch.where(shiftable, (high - low) / 2, radius)
        scale = torch.where(scale < smallest, 1.0, scale)
        sizes = layout.block_index.bincount()[layout.block_index].to(data.device)
        centered = torch.where(
            shiftable, data.var(dim=0, correction=0), squares.mean(dim=0) / sizes
        )
        return cls(layout, scale.float(), offset.float(), centered.sqrt().float())

    def normalize(self, x: torch.Tensor) -> torch.Tensor:
        """Data units to unit size; shapes ``[..., dim] -> [..., dim]``."""
        return (x - self.offset) / self.scale

    def unnormalize(self, x: torch.Tensor) -> torch.Tensor:
        """The inverse of :meth:`normalize`."""
        return x * self.scale + self.offset
