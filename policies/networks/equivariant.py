"""ExpandedLayer layers that commute with a finite planar group, exact by construction.

Features live in regular fields: tensors ``[..., order, channels]`` on which the group permutes
the ``order`` axis, (u f)(g) = f(u^-1 g). Any linear equivariant map between irreps and regular
fields has one of the three forms below (group convolution; Cohen & Welling, arXiv 1602.07576;
the lift per group element follows EDP, arXiv 2407.01812). ``tests/policies`` compares their
number of free parameters with escnn's basis.

Every layer can be written as one ordinary matrix, ``dense()``. Inference computes it once, and
several networks can be stacked into one matrix product. ``nearest()`` is the Reynolds projection of
any matrix onto those of the layer.
"""

from __future__ import annotations

import abc
import copy
import math
from typing import Self

import torch
from torch import nn

from symsteer.policies.geometry import Group, Layout


class EquivariantLayer(nn.Module, abc.ABC):
    """What the layers have in common.

    Attributes:
        in_rank: number of the last axes that are its input: 1 for a vector, 2 for regular fields.
        out_shape: of the last axes of its output.
    """

    group: Group
    weight: torch.Tensor
    bias: torch.Tensor
    in_rank: int
    out_shape: tuple[int, ...]

    @abc.abstractmethod
    def dense(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The map as (matrix, bias)."""

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Apply it to ``x [..., *in]``."""
        out = nn.functional.linear(x.flatten(-self.in_rank), *self.dense())
        return out.unflatten(-1, self.out_shape)

    @abc.abstractmethod
    def nearest(
        self, matrix: torch.Tensor, bias: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """The equivariant map with the smallest distance to another one, as (matrix, bias).

        It is the mean of rho_out(g)^-1 M rho_in(g) over the group; the parameters are not used.

        Args:
            matrix: ``[..., out, in]``.
            bias: ``[..., out]``.
        """

    def without_parameters(self) -> Self:
        """A copy that has the geometry alone, for :meth:`nearest`."""
        bare = copy.copy(self)
        bare._parameters = dict.fromkeys(self._parameters)
        return bare


class Lift(EquivariantLayer):
    """Vector to regular fields: f(g) = W rho(g)^-1 x + b.

    Shapes: ``[..., dim] -> [..., order, channels]``.
    """

    def __init__(self, layout: Layout, group: Group, channels: int):
        super().__init__()
        self.layout, self.group, self.channels = layout, group, channels
        self.in_rank, self.out_shape = 1, (group.order, channels)
        bound = 1 / math.sqrt(layout.dim)
        self.weight = nn.Parameter(torch.empty(channels, layout.dim).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(channels).uniform_(-bound, bound))

    def dense(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The map as (matrix ``[order * channels, dim]``, bias ``[order * channels]``)."""
        # rho is orthogonal, so rho(g)^-1 is its transpose.
        rho = self.group.representation(self.layout, self.weight.dtype, self.weight.device)
        stacked = torch.einsum("cd,ged->gce", self.weight, rho).flatten(0, 1)
        return stacked, self.bias.repeat(self.group.order)

    def nearest(
        self, matrix: torch.Tensor, bias: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        rho = self.group.representation(self.layout, matrix.dtype, matrix.device)
        order = self.group.order
        weight = torch.einsum("...gce,ged->...cd", matrix.unflatten(-2, (order, -1)), rho) / order
        stacked = torch.einsum("...cd,ged->...gce", weight, rho).flatten(-3, -2)
        return stacked, _mean_over_group(bias, order)


class RegularLinear(EquivariantLayer):
    """Group convolution: f'(g) = sum_h W(g^-1 h) f(h) + b.

    Shapes: ``[..., order, in] -> [..., order, out]``.
    """

    index: torch.Tensor

    def __init__(self, group: Group, in_channels: int, out_channels: int):
        super().__init__()
        self.group, self.in_channels, self.out_channels = group, in_channels, out_channels
        self.in_rank, self.out_shape = 2, (group.order, out_channels)
        bound = 1 / math.sqrt(group.order * in_channels)
        self.weight = nn.Parameter(
            torch.empty(group.order, out_channels, in_channels).uniform_(-bound, bound)
        )
        self.bias = nn.Parameter(torch.empty(out_channels).uniform_(-bound, bound))
        # index[g, h] = g^-1 h
        self.register_buffer("index", group.multiplication[group.inverse], persistent=False)

    def dense(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The map as (matrix ``[order * out, order * in]``, bias ``[order * out]``)."""
        order = self.group.order
        blocks = self.weight.index_select(0, self.index.flatten()).unflatten(0, (order, order))
        circulant = blocks.permute(0, 2, 1, 3).reshape(
            order * self.out_channels, order * self.in_channels
        )
        return circulant, self.bias.repeat(order)

    def nearest(
        self, matrix: torch.Tensor, bias: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        order = self.group.order
        blocks = matrix.unflatten(-1, (order, -1)).unflatten(-3, (order, -1)).transpose(-3, -2)
        # blocks[g, h] is W(g^-1 h), so W(u) is the mean of blocks[g, gu].
        flat = blocks.flatten(-4, -3)
        start = order * torch.arange(order, device=matrix.device)[:, None]
        same = (start + self.group.multiplication.to(matrix.device)).flatten()
        weight = flat.index_select(-3, same).unflatten(-3, (order, order)).mean(-4)
        blocks = weight.index_select(-3, self.index.flatten()).unflatten(-3, (order, order))
        return blocks.transpose(-3, -2).flatten(-2).flatten(-3, -2), _mean_over_group(bias, order)


class Project(EquivariantLayer):
    """Regular fields to a vector: y = mean_g rho(g) (V f(g) + b).

    Shapes: ``[..., order, in] -> [..., dim]``. The mean keeps only the invariant part of the bias.
    """

    def __init__(self, group: Group, channels: int, layout: Layout):
        super().__init__()
        self.layout, self.group = layout, group
        self.in_rank, self.out_shape = 2, (layout.dim,)
        bound = 1 / math.sqrt(channels)
        self.weight = nn.Parameter(torch.empty(layout.dim, channels).uniform_(-bound, bound))
        self.bias = nn.Parameter(torch.empty(layout.dim).uniform_(-bound, bound))

    def dense(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The map as (matrix ``[dim, order * in]``, bias ``[dim]``)."""
        rho = self.group.representation(self.layout, self.weight.dtype, self.weight.device)
        stacked = torch.einsum("gde,ec->dgc", rho, self.weight).flatten(1) / self.group.order
        return stacked, rho.mean(0) @ self.bias

    def nearest(
        self, matrix: torch.Tensor, bias: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        rho = self.group.representation(self.layout, matrix.dtype, matrix.device)
        blocks = matrix.unflatten(-1, (self.group.order, -1))
        weight = torch.einsum("gde,...dgc->...ec", rho, blocks) / self.group.order
        return torch.einsum("gde,...ec->...dgc", rho, weight).flatten(-2), bias @ rho.mean(0).mT


def _mean_over_group(bias: torch.Tensor, order: int) -> torch.Tensor:
    """``[..., order * channels]`` with the mean over the group in every place."""
    fields = bias.unflatten(-1, (order, -1))
    return fields.mean(-2, keepdim=True).expand_as(fields).flatten(-2)


class ExpandedLayer(nn.Module):
    """A fixed equivariant layer as one matrix.

    The matrix is computed in float64 and rounded once, so that it is as equivariant as the layer.
    """

    weight: torch.Tensor
    bias: torch.Tensor

    def __init__(self, layer: EquivariantLayer):
        super().__init__()
        self.in_rank, self.out_shape = layer.in_rank, layer.out_shape
        with torch.no_grad():
            weight, bias = copy.deepcopy(layer).double().dense()
        self.register_buffer("weight", weight.to(layer.weight.dtype).contiguous())
        self.register_buffer("bias", bias.to(layer.weight.dtype))

    def dense(self) -> tuple[torch.Tensor, torch.Tensor]:
        return self.weight, self.bias

    forward = EquivariantLayer.forward
