"""Pictures in a vector: where they lie, and how planar symmetries act on their pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch.nn import functional

if TYPE_CHECKING:
    from symsteer.policies.geometry import Layout

PICTURE = "picture_"
"""Fields with this prefix are the channels of a picture from above, one scalar for each pixel."""

PIXEL = 0.01
"""Side of a pixel of a picture from above, metres."""

HAND = "hand_"
"""Fields with this prefix are the channels of a picture from the hand, likewise."""

FIELD_OF_VIEW = 2.2
"""Of a camera in the hand from one side of its picture to the other, radians."""


@dataclass(frozen=True)
class Picture:
    """Where a picture lies in a vector.

    From above: its centre is the origin, rows go from +y to -y, columns from -x to +x.

    From the hand: a perspective picture of what lies ahead of the tool (its z axis), where rows go
    from the tool's +x to -x, columns from -y to +y. It does not change when scene and hand turn
    together.

    Attributes:
        channels: their names.
        side: pixels in a row and in a column.
        columns: ``[channels * side * side]`` int64.
        rest: geometry of the other fields.
        rest_columns: ``[rest.dim]`` int64.
        in_hand: whether it is a picture from the hand.
    """

    channels: tuple[str, ...]
    side: int
    columns: torch.Tensor
    rest: Layout
    rest_columns: torch.Tensor
    in_hand: bool = False

    def of(self, x: torch.Tensor) -> torch.Tensor:
        """The pictures ``[..., channels, side, side]`` in vectors ``[..., dim]``."""
        shape = (len(self.channels), self.side, self.side)
        return x[..., self.columns.to(x.device)].unflatten(-1, shape)

    def changed(self, x: torch.Tensor, rest: torch.Tensor, pictures: torch.Tensor) -> torch.Tensor:
        """``x [..., dim]`` with other pictures, and another ``rest [..., rest.dim]``."""
        changed = torch.empty_like(x)
        changed[..., self.rest_columns.to(x.device)] = rest
        changed[..., self.columns.to(x.device)] = pictures.flatten(-3)
        return changed

    def transform(self, pixels: torch.Tensor, angle: float, reflect: bool) -> torch.Tensor:
        """Pictures ``[..., channels, side, side]`` of the scene that (angle, reflect) acts on."""
        if self.in_hand:
            # The hand is its own mirror image across its x-z plane.
            return pixels.flip(-1) if reflect else pixels
        pixels = pixels.flip(-2) if reflect else pixels
        quarters = round(angle / (math.pi / 2))
        pixels = torch.rot90(pixels, quarters, (-2, -1))
        left = angle - quarters * (math.pi / 2)
        if abs(left) <= 1e-9:
            return pixels
        flat = pixels.reshape(-1, *pixels.shape[-3:])
        return turn_pictures(flat, flat.new_full((len(flat),), left)).view_as(pixels)

    def rotate(self, pixels: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
        """Pictures ``[N, channels, side, side]`` of scenes turned by ``angle [N]``, radians."""
        return pixels if self.in_hand else turn_pictures(pixels, angle)


def hand_rays(side: int) -> torch.Tensor:
    """Unit vectors from a camera in the hand through ``side * side`` pixels, ``[side^2, 3]``.

    In the tool's axes, float64; row by row.
    """
    line = (torch.arange(side, dtype=torch.float64) + 0.5) * (2 / side) - 1
    line = math.tan(FIELD_OF_VIEW / 2) * line
    x, y = torch.meshgrid(-line, line, indexing="ij")
    return functional.normalize(torch.stack([x, y, torch.ones_like(x)], -1).flatten(0, 1), dim=-1)


def turn_pictures(pictures: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """Turn ``pictures [N, channels, side, side]``, each by its ``angle [N]``, radians.

    Bilinear interpolation; what comes in from outside is 0.
    """
    c, s = angle.to(pictures).cos(), angle.to(pictures).sin()
    # A pixel shows what was at the place turned back. In grids y goes down.
    back = torch.stack([torch.stack([c, -s], -1), torch.stack([s, c], -1)], -2)
    matrix = functional.pad(back, (0, 1))
    grid = functional.affine_grid(matrix, list(pictures.shape), align_corners=False)
    return functional.grid_sample(pictures, grid, align_corners=False)
