"""An encoder of pictures from above that commutes with a group of rotations.

    picture --convolutions--> regular fields in every place --one more--> a weight for every place
    keypoint (g, k) = mean of what is shown under the weights of group element g, channel k

A pixel has mass in proportion to its value, and 0 shows nothing. A place lies at the centre of its
mass, and its weights are multiplied by its mass. So a keypoint lies on bodies from the start, also
between pixels.

The convolutions are steerable (escnn); over the trivial group they are ordinary. A turned picture
turns the keypoints and permutes their group elements. Pixels turn into pixels under quarter turns
only: these are exact, other turns up to the error of interpolation.
"""

from __future__ import annotations

import copy
import math
from typing import Any, ClassVar, Self

import torch
from torch import nn
from torch.nn import functional

from symsteer.errors import UserError
from symsteer.policies.geometry import Group, escnn_package
from symsteer.policies.networks.keypoints import KeypointEncoder
from symsteer.policies.picture import PIXEL, Picture

KERNELS = ((10, 4, 3), (5, 1, 2))
"""Size, stride and padding of each convolution; on an even number of pixels quarter turns keep all
of them."""

SHRINK = 4
"""Pixels of the picture to a place of the last convolution."""

LEAST = 1e-9
"""Mass of an empty place, where one full of the largest values has 1 for each channel."""


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


class PictureEncoder(KeypointEncoder):
    """Puts what a picture tells in its place in an observation; shapes are in half sides.

    Args:
        picture: geometry of the picture.
        group: of rotations, C_n.

    Raises:
        UserError: if quarter turns do not keep the pixels that the last convolution has.
    """

    counts: ClassVar[dict[bool, tuple[int, int]]] = {True: (4, 4), False: (6, 24)}
    """Channels and keypoints for each element of a group, and those of the trivial group: as many
    parameters as C8 has, about as many numbers (tests/policies/test_pictures.py)."""

    def __init__(self, picture: Picture, group: Group):
        channels, keypoints = self.counts[group.order > 1]
        super().__init__(picture, group, keypoints, picture.channels, picture.side * PIXEL / 2)
        self.picture = picture
        if picture.side % SHRINK:
            raise UserError(
                f"a picture of {picture.side} x {picture.side} pixels has no quarter turns after "
                f"{SHRINK} of them became one; choose a multiple of {SHRINK}"
            )
        colors = len(picture.channels)
        self.layers = nn.ModuleList(
            PictureConvolution(group, channels if i else colors, channels, shape, not i)
            for i, shape in enumerate(KERNELS)
        )
        self.weigh = PictureConvolution(group, channels, self.keypoints, (1, 1, 0), False)

    def seen_values(self, obs: torch.Tensor) -> torch.Tensor:
        return self.picture.of(obs).flatten(2)

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
        picture = self.picture.of(obs)
        side = self.picture.side
        mass = (picture / self.scale[:, None, None]).abs().sum(1, keepdim=True)
        where = _pixels(side, picture)
        moments = torch.cat([mass, mass * where, mass * picture], dim=1)
        moments = functional.avg_pool2d(moments, SHRINK).flatten(2)
        mass = moments[:, :1] + LEAST
        weights = (self.logits(picture) + mass.log()[:, None]).softmax(-1)
        means = moments[:, 1:] / mass
        return self.tell(weights, means[:, :2].mT[:, None], means[:, 2:])

    def expanded(self) -> Self:
        fast = copy.deepcopy(self)
        fast.layers = nn.ModuleList(FixedConvolution(layer) for layer in self.layers)
        fast.register_module("weigh", FixedConvolution(self.weigh))
        return fast.requires_grad_(False).eval()


def _channels_last(x: torch.Tensor) -> torch.Tensor:
    """In the order of memory in which convolutions take a third less time."""
    return x.contiguous(memory_format=torch.channels_last)


def _pixels(side: int, like: torch.Tensor) -> torch.Tensor:
    """Centres of pixels ``[2, side, side]``, rows from +y to -y, in [-1, 1]."""
    line = (torch.arange(side, device=like.device, dtype=like.dtype) + 0.5) * (2 / side) - 1
    return torch.stack([line.expand(side, side), -line[:, None].expand(side, side)])
