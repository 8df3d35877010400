"""Symmetry by lifting: the Equivariant Diffusion Policy (EDP, arXiv 2407.01812).

    observation --Lift--> regular fields --group convolution--> one embedding per group element
    noisy chunk --Lift--> one slice per group element
    every slice: the same denoising network, conditioned on its embedding and the noise level
    slices --Project--> chunk

Acting with the group on observation and chunk permutes the slices. The shared network keeps the
permutation, and ``Project`` turns it back into the group's action. This is exact for any network
in the middle. With the trivial group C1 there is one slice: an ordinary diffusion policy.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import nn
from torch.nn import functional

from symsteer.policies.geometry import Group, Layout
from symsteer.policies.networks.denoiser import Denoiser
from symsteer.policies.networks.equivariant import (
    EquivariantLayer,
    ExpandedLayer,
    Lift,
    Project,
    RegularLinear,
)
from symsteer.policies.networks.slices import FixedResidualMLP, ResidualMLP, TemporalUNet
from symsteer.policies.training.denoising import DenoisingOptions, DiffusionPolicy


class LiftedDenoiser(Denoiser):
    """A denoiser that commutes with a finite group.

    Args:
        options: horizon and sizes, for each group element.
        obs_layout: geometry of one (normalised) observation.
        act_layout: geometry of one (normalised) action.
        group: a finite group.
    """

    def __init__(
        self, options: DenoisingOptions, obs_layout: Layout, act_layout: Layout, group: Group
    ):
        super().__init__()
        self.group = group
        channels, width = options.channels, options.width
        # The MLP sees the chunk as one long vector, the U-Net as a sequence of actions.
        self.flat = options.network == "mlp"
        layout = act_layout.repeat(options.horizon) if self.flat else act_layout
        make = self.make_layer
        self.obs_lift = make(Lift(obs_layout, group, channels))
        self.obs_mix = make(RegularLinear(group, channels, channels))
        self.chunk_lift = make(Lift(layout, group, width))
        self.slice_network = ResidualMLP(width, options.depth) if self.flat else TemporalUNet(width)
        self.project = make(Project(group, width, layout))
        self.condition = nn.Linear(channels, self.slice_network.condition_dim)
        self.add_time_layers(self.slice_network.condition_dim)

    def make_layer(self, layer: EquivariantLayer) -> nn.Module:
        """The layer that is used; a subclass may put its own in the place of this one."""
        return layer

    def embed(self, obs: torch.Tensor) -> torch.Tensor:
        """Embedding of an observation; ``[B, obs_dim] -> [B, order, channels]``."""
        return self.obs_mix(functional.silu(self.obs_lift(obs)))

    def encode(self, obs: torch.Tensor) -> torch.Tensor:
        """What the network sees of it; ``[B, obs_dim] -> [B, order, condition]``."""
        return self.condition(functional.silu(self.embed(obs)))

    def encode_time(self, t: torch.Tensor) -> torch.Tensor:
        """What the network sees of the noise level; ``[B] -> [B, 1, condition]``."""
        return super().encode_time(t)[:, None]

    def forward(self, x: torch.Tensor, context: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
        """Predict; ``x [B, Tp, Da]``, ``context [B, order, c]``, ``time [B or 1, 1, c]``."""
        if self.flat:
            slices = self.slice_network(self.chunk_lift(x.flatten(1)), context, time)
            return self.project(slices).view_as(x)
        # [B, T, order, width] -> [B * order, T, width]
        slices = self.chunk_lift(x).transpose(1, 2).flatten(0, 1)
        slices = self.slice_network(slices, (context + time).flatten(0, 1))
        return self.project(slices.unflatten(0, context.shape[:2]).transpose(1, 2))

    def output_layers(self) -> list[nn.Module]:
        """The projection to the chunk."""
        return [self.project]

    def expanded(self) -> LiftedDenoiser:
        """A copy for inference whose equivariant layers hold their dense matrices ready."""
        fast = super().expanded()
        for name in ("obs_lift", "obs_mix", "chunk_lift", "project"):
            layer = getattr(self, name)
            if hasattr(layer, "dense"):
                fast.register_module(name, ExpandedLayer(layer))
        if isinstance(self.slice_network, ResidualMLP):
            fast.register_module("slice_network", FixedResidualMLP(self.slice_network))
        return fast


@dataclass(frozen=True)
class EquivariantOptions(DenoisingOptions):
    """Options of the equivariant diffusion policy."""

    group: str = "C8"
    """The finite symmetry group: C_n or D_n."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = Group.parse(self.group).order


class EquivariantDiffusionPolicy(DiffusionPolicy):
    """Equivariant Diffusion Policy (arXiv 2407.01812): symmetric by construction."""

    name = "edp"
    Options = EquivariantOptions
    options: EquivariantOptions

    @classmethod
    def picture_group(cls, options: Any) -> Group:
        """That of the options."""
        return Group.parse_rotations(options.group)

    def make_denoiser(self) -> LiftedDenoiser:
        """The lifted network over the options' group."""
        group = Group.parse(self.options.group)
        return LiftedDenoiser(self.options, self.obs_layout, self.chunk_layout, group)
