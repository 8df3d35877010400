"""The lifted network with escnn's layers (https://github.com/QUVA-Lab/escnn).

The same functions as those of ``edp``: our layers and escnn's span the same linear maps, and the
rest is shared, as are the first weights. Training takes longer, because escnn expands its bases in
every step; decoding does not. It is here for escnn's networks: any of them may encode the
observation (:meth:`EscnnDiffusionPolicy.make_encoder`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Self

import torch
from torch import nn
from torch.nn import functional

from symsteer.policies.geometry import Field, Group, Layout, escnn_package
from symsteer.policies.networks.equivariant import EquivariantLayer, Lift, Project, RegularLinear
from symsteer.policies.symmetry.lifted import EquivariantOptions, LiftedDenoiser
from symsteer.policies.training.denoising import DiffusionPolicy

if TYPE_CHECKING:
    from escnn.nn import EquivariantModule, FieldType

ANY = Layout([Field("any", 1)])
"""Stands for the vector that a layer between regular fields does not have."""


class EscnnLayer(nn.Module):
    """One of our layers with the coefficients of an ``escnn.nn.Linear``.

    escnn orders regular fields as ``[channels, order]``; tensors here are ``[order, channels]``.

    Args:
        ours: the layer whose place it takes; both give the same until one of them is trained.
            With escnn's own initialisation the policy learns worse (``docs/base-policies.md``).
    """

    def __init__(self, ours: EquivariantLayer):
        super().__init__()
        if isinstance(ours, Lift):
            layout, ends = ours.layout, (0, ours.channels)
        elif isinstance(ours, Project):
            layout, ends = ours.layout, (ours.weight.shape[1], 0)
        else:
            assert isinstance(ours, RegularLinear)
            layout, ends = ANY, (ours.in_channels, ours.out_channels)
        self.geometry = ours.without_parameters()
        self.in_rank, self.out_shape = ours.in_rank, ours.out_shape
        self.ends, self.order = ends, ours.group.order
        vector = layout.field_type(ours.group)
        linear = escnn_package().nn.Linear(
            *(regular_fields(vector, count) if count else vector for count in ends),
            initialize=False,
        )
        # No submodules: bases are no state.
        self.__dict__["_bases"] = linear.basisexpansion, getattr(linear, "bias_expansion", None)
        self.weight = nn.Parameter(torch.ones_like(linear.weights))
        self.bias = None if linear.bias is None else nn.Parameter(torch.ones_like(linear.bias))
        self._start_as(*ours.dense())

    def dense(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Matrix and bias in our order, equivariant to the precision of their type.

        escnn's bases have the precision of float32; the nearest equivariant matrix is exact.
        """
        return self.geometry.nearest(*self._expanded())

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """As the layer in whose place it is."""
        out = functional.linear(x.flatten(-self.in_rank), *self._expanded())
        return out.unflatten(-1, self.out_shape)

    @torch.enable_grad()
    def _start_as(self, matrix: torch.Tensor, bias: torch.Tensor) -> None:
        # The elements of escnn's bases are orthogonal. With all coefficients 1, the product of the
        # map with one element is that element's squared norm. A map to vectors may have no bias.
        for parameter, ones, wanted in zip(
            self.parameters(), self._expanded(), (matrix, bias), strict=False
        ):
            (product,) = torch.autograd.grad(ones, parameter, wanted.detach(), retain_graph=True)
            (squared_norm,) = torch.autograd.grad(ones, parameter, ones.detach())
            parameter.data = product / squared_norm

    def _expanded(self) -> tuple[torch.Tensor, torch.Tensor]:
        basis, bias_basis = self.__dict__["_bases"]
        matrix = basis.to(self.weight)(self.weight).flatten(1)
        bias = matrix.new_zeros(len(matrix))
        if self.bias is not None:
            bias = bias_basis.to(self.bias) @ self.bias
        inputs, outputs = ((count, self.order) for count in self.ends)
        if inputs[0]:
            matrix = matrix.unflatten(1, inputs).mT.flatten(1)
        if outputs[0]:
            matrix = matrix.unflatten(0, outputs).transpose(0, 1).flatten(0, 1)
            bias = bias.unflatten(0, outputs).mT.flatten()
        return matrix, bias


def regular_fields(like: FieldType, count: int) -> FieldType:
    """``count`` regular fields over the space of a type."""
    return escnn_package().nn.FieldType(like.gspace, [like.gspace.regular_repr] * count)


class EscnnDenoiser(LiftedDenoiser):
    """The lifted denoiser with escnn's layers, and any escnn network as its encoder.

    Args:
        encoder: from the observation's type to ``channels`` regular fields; None: the two layers of
            the lifted denoiser.
        args: those of the lifted denoiser.
    """

    def __init__(self, encoder: EquivariantModule | None, *args: Any):
        super().__init__(*args)
        self.encoder = encoder
        if encoder is not None:
            self.obs_lift = self.obs_mix = nn.Identity()
            self.points = None

    def make_layer(self, layer: EquivariantLayer) -> nn.Module:
        """escnn's layer in the place of ours."""
        return EscnnLayer(layer)

    def embed(self, obs: torch.Tensor) -> torch.Tensor:
        """The encoder's regular fields, ``[B, order, channels]``."""
        if self.encoder is None:
            return super().embed(obs)
        seen = escnn_package().nn.GeometricTensor(obs, self.encoder.in_type)
        return self.encoder(seen).tensor.unflatten(1, (-1, self.group.order)).mT

    def train(self, mode: bool = True) -> Self:
        """escnn's modules expand their matrices here; a copy needs them without gradients."""
        with torch.no_grad():
            return super().train(mode)


class EscnnDiffusionPolicy(DiffusionPolicy):
    """Equivariant diffusion policy with escnn's layers; needs escnn."""

    name = "escnn"
    Options = EquivariantOptions
    options: EquivariantOptions

    @classmethod
    def picture_group(cls, options: Any) -> Group:
        """That of the options."""
        return Group.parse_rotations(options.group)

    def make_denoiser(self) -> LiftedDenoiser:
        """The lifted network over the options' group, with :meth:`make_encoder`."""
        options, group = self.options, Group.parse(self.options.group)
        seen = self.obs_layout.field_type(group)
        encoder = self.make_encoder(seen, regular_fields(seen, options.channels))
        return EscnnDenoiser(encoder, options, self.obs_layout, self.chunk_layout, group)

    def make_encoder(self, seen: FieldType, embedding: FieldType) -> EquivariantModule | None:
        """An escnn module from normalised observations to regular fields; a subclass may say which.

        Args:
            seen: type of its input.
            embedding: type that its output must have.
        """
        return None
