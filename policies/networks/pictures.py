"""An encoder of pictures from above that commutes with a group of rotations.

    picture --convolutions--> regular fields in every place --one more--> a weight for every place
    keypoint (g, k) = mean of all places under the weights of group element g, channel k

The convolutions are steerable (escnn); over the trivial group they are ordinary. A turned picture
turns the keypoints and permutes their group elements. So the numbers

    z_j = mean over g of (cos j a_g, sin j a_g) (g^-1 keypoint (g, k))     (a complex product)

are planar vectors that turn by j times the angle (frequency j). z_1 is the mean place of keypoint
k; the others tell of its shape. Pixels turn into pixels under quarter turns only: these are exact,
other turns up to the error of interpolation.
"""

from __future__ import annotations

import copy
import math
from collections import Counter
from typing import Any, ClassVar, Self

import torch
from torch import nn
from torch.nn import functional

from symsteer.errors import UserError
from symsteer.policies.geometry import Field, Group, Layout, escnn_package
from symsteer.policies.normalizer import MINIMUM_RANGE, Normalizer
from symsteer.policies.picture import PIXEL, Picture

KERNELS = ((10, 4, 3), (5, 1, 2))
"""Size, stride and padding of each convolution; on an even number of pixels quarter turns keep all
of them."""

SHRINK = 4
"""Pixels of the picture to a place of the last convolution."""

REACH = 0.1
"""Metres that have unit size for the networks. Most of a keypoint's weights lie elsewhere, so that
it moves less than what it follows."""


class PictureConvolution(nn.Module):
    """A convolution between fields over the plane.

    Args:
        group: of rotations, C_n.
        ins, outs: channels for each group element; ``ins`` are invariant if ``first``.
        shape: size, stride and padding.
        first: whether its input is a picture.
    """

    def __init__(self, group: Group, ins: int, outs: int, shape: tuple[int, int, int], first: bool):
        super().__init__()
        self.order = group.order
        self.orders = 1 if first else group.order, group.order
        size, self.stride, self.padding = shape
        self.bias = nn.Parameter(torch.zeros(outs))
        if group.order == 1:
            self.weight = nn.Conv2d(ins, outs, size).weight
            return
        escnn = escnn_package()
        space = escnn.gspaces.rot2dOnR2(group.order)
        before = space.trivial_repr if first else space.regular_repr
        types = (
            escnn.nn.FieldType(space, [representation] * count)
            for representation, count in ((before, ins), (space.regular_repr, outs))
        )
        convolution = escnn.nn.R2Conv(*types, kernel_size=size, bias=False)
        # No submodule: bases are no state.
        self.__dict__["_basis"], self._size = convolution.basisexpansion, size
        self.weight = nn.Parameter(convolution.weights.detach().clone())

    def dense(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Filter ``[outs * order, ins * order, size, size]`` and bias ``[outs * order]``."""
        if self.order == 1:
            return self.weight, self.bias
        basis = self.__dict__["_basis"].to(self.weight)
        filters = basis(self.weight).unflatten(-1, (self._size, self._size))
        # escnn's bases have the precision of float32; the mean over quarter turns is exact.
        turns = math.gcd(4, self.order)
        turned = [self._turned(filters, turn * 4 // turns) for turn in range(turns)]
        return torch.stack(turned).mean(0), self.bias.repeat_interleave(self.order)

    def _turned(self, filters: torch.Tensor, quarters: int) -> torch.Tensor:
        """The filter turned by quarter turns, with both of its fields."""
        before, after = self.orders
        parts = torch.rot90(filters, quarters, (-2, -1))
        parts = parts.unflatten(1, (-1, before)).unflatten(0, (-1, after))
        shifts = (after * quarters // 4, before * quarters // 4)
        return parts.roll(shifts, (1, 3)).flatten(2, 3).flatten(0, 1)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """``[B, ins * order, S, S] -> [B, outs * order, S', S']``."""
        weight, bias = self.dense()
        return functional.conv2d(x, _channels_last(weight), bias, self.stride, self.padding)


class FixedConvolution(nn.Module):
    """The same with its filter ready, computed in float64 and rounded once."""

    weight: torch.Tensor
    bias: torch.Tensor

    def __init__(self, layer: Any):
        super().__init__()
        self.stride, self.padding = layer.stride, layer.padding
        with torch.no_grad():
            weight, bias = copy.deepcopy(layer).double().dense()
        self.register_buffer("weight", _channels_last(weight.to(layer.weight.dtype)))
        self.register_buffer("bias", bias.to(layer.weight.dtype))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        return functional.conv2d(x, self.weight, self.bias, self.stride, self.padding)


class PictureEncoder(nn.Module):
    """Puts what a picture tells in its place in an observation.

    Args:
        picture: geometry of the picture.
        group: of rotations, C_n.

    Attributes:
        told: geometry of what the picture tells: for each keypoint its mean place in metres and,
            there, the mean of each channel of the picture; then the shapes, in half sides.
        layout: the same in its place in the observation.
        scale: the largest value of each channel of the picture, ``[channels]``.

    Raises:
        UserError: if quarter turns do not keep the pixels that the last convolution has.
    """

    counts: ClassVar[dict[bool, tuple[int, int]]] = {True: (4, 4), False: (6, 24)}
    """Channels and keypoints for each element of a group, and those of the trivial group: as many
    parameters as C8 has, about as many numbers (tests/policies/test_pictures.py)."""
    scale: torch.Tensor

    def __init__(self, picture: Picture, group: Group):
        super().__init__()
        self.picture, self.group = picture, group
        if picture.side % SHRINK:
            raise UserError(
                f"a picture of {picture.side} x {picture.side} pixels has no quarter turns after "
                f"{SHRINK} of them became one; choose a multiple of {SHRINK}"
            )
        channels, self.keypoints = self.counts[group.order > 1]
        colors = len(picture.channels)
        self.layers = nn.ModuleList(
            PictureConvolution(group, channels if i else colors, channels, shape, not i)
            for i, shape in enumerate(KERNELS)
        )
        self.weigh = PictureConvolution(group, channels, self.keypoints, (1, 1, 0), False)
        self.register_buffer("scale", torch.ones(colors))
        n = group.order
        turns = sorted((j if 2 * j <= n else j - n for j in range(n)), key=abs) if n > 1 else [1]
        self.turns = [1, *(j for j in turns if j != 1)]
        self.told = Layout(self.told_fields())
        # Numbers of the observation before the picture.
        self.start = int(picture.columns[0])
        before, after = picture.rest.split(self.start)
        self.layout = Layout([*before, *self.told.fields, *after])

    def told_fields(self) -> list[Field]:
        """Geometry of what the picture tells."""
        fields = [
            field
            for k in range(self.keypoints)
            for field in (
                Field(f"keypoint{k}_place", 1),
                *(Field(f"keypoint{k}_{name}", 0) for name in self.picture.channels),
            )
        ]
        count = Counter(abs(j) for j in self.turns[1:])
        return fields + [
            Field(f"shape{j}", j, times * self.keypoints * (1 if j else 2))
            for j, times in count.items()
        ]

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Observations with a picture as ``[B, layout.dim]``, environment units."""
        rest = obs[:, self.picture.rest_columns.to(obs.device)]
        told = self.encode(obs)
        return torch.cat([rest[:, : self.start], told, rest[:, self.start :]], dim=1)

    def statistics(self, obs: torch.Tensor, rest: Normalizer) -> Normalizer:
        """Learn the scale from ``obs [M, dim]``; the normaliser of what is made of them.

        What the picture tells has a size by itself. Statistics would change while it is learned.

        Args:
            obs: demonstrated observations.
            rest: normaliser of the other fields.
        """
        self.scale.copy_(self.picture.of(obs).abs().amax(dim=(0, 2, 3)).clamp_min(MINIMUM_RANGE))
        sizes = self.sizes()

        def around(values: torch.Tensor, told: torch.Tensor) -> torch.Tensor:
            return torch.cat([values[: self.start], told.to(values), values[self.start :]])

        return Normalizer(
            self.layout,
            around(rest.scale, sizes),
            around(rest.offset, 0 * sizes),
            around(rest.deviation, sizes),
        )

    def sizes(self) -> torch.Tensor:
        """What has unit size for the networks of what the picture tells, ``[told.dim]``."""
        sizes = torch.full((self.told.dim,), REACH / (self.picture.side * PIXEL / 2))
        for field in self.told.fields:
            _, _, part = field.name.partition("_")
            if part in self.picture.channels:
                size = float(self.scale[self.picture.channels.index(part)])
                sizes[self.told.slice(field.name)] = size
            elif part:
                sizes[self.told.slice(field.name)] = REACH
        return sizes

    def logits(self, picture: torch.Tensor) -> torch.Tensor:
        """How much each place of ``picture [B, channels, side, side]`` is looked at.

        Returns:
            ``[B, keypoints, order, places]``.
        """
        x = _channels_last(picture / self.scale[:, None, None])
        for layer in self.layers:
            x = functional.relu(layer(x))
        return self.weigh(x).flatten(2).unflatten(1, (self.keypoints, -1))

    def encode(self, obs: torch.Tensor) -> torch.Tensor:
        """What the pictures of observations tell, ``[B, told.dim]``, environment units."""
        picture = self.picture.of(obs)
        weights = self.logits(picture).softmax(-1)
        seen = functional.avg_pool2d(picture, SHRINK).flatten(2)
        places = _places(self.picture.side // SHRINK, weights)
        n, half = self.group.order, self.picture.side * PIXEL / 2
        # [B, keypoints, order]; `unit` turns each back by its element.
        z = torch.view_as_complex((weights @ places).contiguous())
        angle = torch.arange(n, device=z.device, dtype=weights.dtype) * (2 * math.pi / n)
        values = weights.mean(2) @ seen.mT
        parts = []
        for j in self.turns:
            unit = torch.polar(torch.ones_like(angle), angle * (j - 1)).to(z)
            mean = torch.view_as_real((z * unit).mean(-1))
            # The conjugate of a vector of frequency -j has frequency j.
            parts.append(mean * mean.new_tensor([1, -1 if j < 0 else 1]))
        first = torch.cat([half * parts[0], values], dim=-1)
        return torch.cat([first.flatten(1), *(part.flatten(1) for part in parts[1:])], dim=1)

    def expanded(self) -> Self:
        """A copy for inference with its filters ready."""
        fast = copy.deepcopy(self)
        fast.layers = nn.ModuleList(FixedConvolution(layer) for layer in self.layers)
        fast.register_module("weigh", FixedConvolution(self.weigh))
        return fast.requires_grad_(False).eval()


def _channels_last(x: torch.Tensor) -> torch.Tensor:
    """In the order of memory in which convolutions take a third less time."""
    return x.contiguous(memory_format=torch.channels_last)


def _places(side: int, like: torch.Tensor) -> torch.Tensor:
    """Centres of the places of a picture, rows from +y to -y, ``[side * side, 2]`` in [-1, 1]."""
    line = (torch.arange(side, device=like.device, dtype=like.dtype) + 0.5) * (2 / side) - 1
    return torch.stack([line.expand(side, side), -line[:, None].expand(side, side)], -1).flatten(
        0, 1
    )
