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
from collections.abc import Mapping
from typing import Any, Self

import torch
from torch import nn

from symsteer.policies.geometry import Group, Layout


class MatrixLayer(nn.Module):
    """A linear layer that can be written as one matrix."""

    def dense(self) -> tuple[torch.Tensor, torch.Tensor]:
        """The map as (matrix ``[out, in]``, bias ``[out]``)."""
        return self.dense_of(dict(self.named_parameters()))

    def dense_of(self, parameters: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        """The maps of layers like this one, as (matrix ``[..., out, in]``, bias ``[..., out]``).

        Args:
            parameters: of these layers by name; they have the dimensions ``...`` in front.
        """
        raise NotImplementedError


class EquivariantLayer(MatrixLayer, abc.ABC):
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

    def dense_of(self, parameters: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        weight, bias = parameters["weight"], parameters["bias"]
        # rho is orthogonal, so rho(g)^-1 is its transpose.
        rho = self.group.representation(self.layout, weight.dtype, weight.device)
        stacked = torch.einsum("...cd,ged->...gce", weight, rho).flatten(-3, -2)
        return stacked, _everywhere(bias, self.group.order)

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
    same: torch.Tensor

    def __init__(self, group: Group, in_channels: int, out_channels: int):
        super().__init__()
        self.group, self.in_channels, self.out_channels = group, in_channels, out_channels
        self.in_rank, self.out_shape = 2, (group.order, out_channels)
        bound = 1 / math.sqrt(group.order * in_channels)
        self.weight = nn.Parameter(
            torch.empty(group.order, out_channels, in_channels).uniform_(-bound, bound)
        )
        self.bias = nn.Parameter(torch.empty(out_channels).uniform_(-bound, bound))
        # Of the blocks [g, h] the element g^-1 h; and of each element u the blocks [g, gu].
        start = group.order * torch.arange(group.order)[:, None]
        places = {
            "index": group.multiplication[group.inverse].flatten(),
            "same": (start + group.multiplication).flatten(),
        }
        for name, place in places.items():
            self.register_buffer(name, place, persistent=False)

    def dense_of(self, parameters: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        order = self.group.order
        blocks = _Blocks.apply(parameters["weight"], self.index, self.same)
        blocks = blocks.unflatten(-3, (order, order))
        circulant = blocks.transpose(-3, -2).flatten(-2).flatten(-3, -2)
        return circulant, _everywhere(parameters["bias"], order)

    def nearest(
        self, matrix: torch.Tensor, bias: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        order = self.group.order
        blocks = matrix.unflatten(-1, (order, -1)).unflatten(-3, (order, -1)).transpose(-3, -2)
        # blocks[g, h] is W(g^-1 h), so W(u) is the mean of blocks[g, gu].
        flat = blocks.flatten(-4, -3)
        weight = flat.index_select(-3, self.same).unflatten(-3, (order, order)).mean(-4)
        blocks = weight.index_select(-3, self.index).unflatten(-3, (order, order))
        return blocks.transpose(-3, -2).flatten(-2).flatten(-3, -2), _mean_over_group(bias, order)


class _Blocks(torch.autograd.Function):
    """The weights ``[..., order, out, in]`` of all blocks, ``[..., order * order, out, in]``.

    Its derivative sums the same blocks in the same order every time; that of ``index_select`` does
    not on a GPU.
    """

    generate_vmap_rule = True

    @staticmethod
    def forward(weight: torch.Tensor, index: torch.Tensor, same: torch.Tensor) -> torch.Tensor:
        return weight.index_select(-3, index)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[torch.Tensor, ...], output: torch.Tensor) -> None:
        ctx.same, ctx.order = inputs[2], inputs[0].shape[-3]

    @staticmethod
    def backward(ctx: Any, *gradients: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        blocks = gradients[0].index_select(-3, ctx.same)
        return blocks.unflatten(-3, (ctx.order, -1)).sum(-4), None, None


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

    def dense_of(self, parameters: Mapping[str, torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
        weight, bias = parameters["weight"], parameters["bias"]
        rho = self.group.representation(self.layout, weight.dtype, weight.device)
        stacked = torch.einsum("gde,...ec->...dgc", rho, weight).flatten(-2) / self.group.order
        return stacked, bias @ rho.mean(0).mT

    def nearest(
        self, matrix: torch.Tensor, bias: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        rho = self.group.representation(self.layout, matrix.dtype, matrix.device)
        blocks = matrix.unflatten(-1, (self.group.order, -1))
        weight = torch.einsum("gde,...dgc->...ec", rho, blocks) / self.group.order
        return torch.einsum("gde,...ec->...dgc", rho, weight).flatten(-2), bias @ rho.mean(0).mT


def _everywhere(bias: torch.Tensor, order: int) -> torch.Tensor:
    """``[..., channels]`` for each element of the group, ``[..., order * channels]``."""
    return bias.unsqueeze(-2).expand(*bias.shape[:-1], order, bias.shape[-1]).flatten(-2)


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
