"""Symmetry under every rotation: features that are irreps, in the plane or in space.

- ``so2``: frequencies of SO(2). The limit of the lifted network for finer and finer groups.
- ``spherical``: degrees 0 to 2 of SO(3), for scenes that have no fixed vertical (after SDP, arXiv
  2507.01723, which samples its features on a sphere; here they are coupled without sampling, so
  that the network is exact for every rotation).

    observation -> features, coupled with each other -> vectors and tensors, invariants
    noisy chunk -> features + those of the observation
    blocks: norm, linear, FiLM by the invariants and the noise level, coupling, gate, linear
    features -> chunk
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import nn
from torch.nn import functional

from symsteer.errors import UserError
from symsteer.policies.geometry import Field, Group, Layout
from symsteer.policies.networks.denoiser import Denoiser
from symsteer.policies.networks.irreps import (
    Coupling,
    Enter,
    EquivariantMap,
    Film,
    Gate,
    Irreps,
    Leave,
    Norm,
    PlanarIrreps,
    SpatialIrreps,
)
from symsteer.policies.training.denoising import DenoisingOptions, DiffusionPolicy

NORMAL = ("normal_xy", "normal_z")
"""The table's normal in an observation."""


class Mixing(nn.Module):
    """h <- h + W gate(film(u) x V film(u)), u = U norm(h); x couples channel by channel."""

    def __init__(self, irreps: Irreps, channels: int):
        super().__init__()
        self.norm = Norm(irreps, channels)
        self.inner = EquivariantMap(irreps, channels, channels)
        self.film = Film(irreps, channels)
        self.other = EquivariantMap(irreps, channels, channels)
        self.coupling = Coupling(irreps, channels)
        self.gate = Gate(irreps, channels)
        self.outer = EquivariantMap(irreps, channels, channels)

    def forward(self, h: torch.Tensor, condition: torch.Tensor | None = None) -> torch.Tensor:
        """``h [B, channels, dim]``, ``condition [B, film]``."""
        u = self.inner(self.norm(h))
        if condition is not None:
            u = self.film(u, condition)
        return h + self.outer(self.gate(u + self.coupling(u, self.other(u))))


class IrrepDenoiser(Denoiser):
    """A denoiser that commutes with every rotation.

    Args:
        irreps: of the features.
        options: horizon and sizes; ``depth`` is that of the chunk, the observation has two blocks.
        obs_layout: geometry of one (normalised) observation.
        act_layout: geometry of one (normalised) action.
    """

    def __init__(
        self, irreps: Irreps, options: SteerableOptions, obs_layout: Layout, act_layout: Layout
    ):
        super().__init__()
        self.irreps, self.group = irreps, Group.parse(options.symmetry)
        channels, width, depth = options.channels, options.width, options.depth
        layout = act_layout.repeat(options.horizon)
        self.obs_in = Enter(irreps, obs_layout, channels)
        self.obs_blocks = nn.ModuleList(Mixing(irreps, channels) for _ in range(2))
        self.obs_out = EquivariantMap(irreps, channels, width)
        self.chunk_in = Enter(irreps, layout, width)
        self.blocks = nn.ModuleList(Mixing(irreps, width) for _ in range(depth))
        self.out_norm = Norm(irreps, width)
        self.chunk_out = Leave(irreps, layout, width)
        films = depth * Film(irreps, width).condition_dim
        self.condition = nn.Linear(channels, films)
        self.add_time_layers(films)

    def encode(self, obs: torch.Tensor) -> torch.Tensor:
        """Features for the chunk and FiLM of the invariants, ``[B, width * dim + films]``."""
        h = self.obs_in(obs)
        for block in self.obs_blocks:
            h = block(h)
        films = self.condition(functional.silu(h[..., 0]))
        return torch.cat([self.obs_out(h).flatten(1), films], dim=-1)

    def features(self, x: torch.Tensor, context: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
        """What a chunk is read from; ``x [B, Tp, Da] -> [B, width, dim]``."""
        films = len(self.time_out.weight)
        features, condition = context.split([context.shape[1] - films, films], dim=-1)
        h = self.chunk_in(x.flatten(1)) + features.unflatten(-1, (-1, self.irreps.dim))
        conditions = (condition + time).chunk(len(self.blocks), dim=-1)
        for block, part in zip(self.blocks, conditions, strict=True):
            h = block(h, part)
        return self.out_norm(h)

    def forward(self, x: torch.Tensor, context: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
        """Predict; see :meth:`Denoiser.forward`."""
        return self.chunk_out(self.features(x, context, time)).view_as(x)

    def output_layers(self) -> list[nn.Module]:
        """The map to the chunk."""
        return [self.chunk_out]


class SpatialDenoiser(IrrepDenoiser):
    """A denoiser that commutes with every rotation of space, above a table with a normal n.

    A vector of the chunk is (1 - n n^T) A h1 + n b (h0, n^T h1), with features h of degree 0 and 1:
    what lies across the normal and what lies along it have weights of their own. With A h1 alone
    the same weights answered for a gripper's turn about the normal and for its tilt. The errors of
    the turn are larger, so the small ones of the tilt remained, and added up with every action.
    """

    vectors: torch.Tensor
    normal: torch.Tensor

    def __init__(
        self, irreps: Irreps, options: SteerableOptions, obs_layout: Layout, act_layout: Layout
    ):
        super().__init__(irreps, options, obs_layout, act_layout)
        vectors = irreps.embedding(act_layout.repeat(options.horizon))[1]
        self.along = nn.Linear(2 * self.chunk_in.channels, len(vectors))
        self.register_buffer("vectors", vectors.flatten(0, 1), persistent=False)
        # Vectors in space are the first ones of the embedding.
        normal = irreps.embedding(obs_layout)[1][obs_layout.spatial_vectors().index(NORMAL)]
        self.register_buffer("normal", normal, persistent=False)

    def encode(self, obs: torch.Tensor) -> torch.Tensor:
        """As the network without a normal, and the normal; ``[B, width * dim + films + 3]``."""
        return torch.cat([super().encode(obs), obs @ self.normal.mT], dim=-1)

    def forward(self, x: torch.Tensor, context: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
        """Predict; see :meth:`Denoiser.forward`."""
        context, normal = context.split([context.shape[1] - 3, 3], dim=-1)
        h = self.features(x, context, time)
        out = self.chunk_out(h)
        across = torch.einsum("bnd,bd->bn", (out @ self.vectors.mT).unflatten(-1, (-1, 3)), normal)
        heights = torch.einsum("bcd,bd->bc", h[..., self.irreps.slice(1)], normal)
        along = self.along(torch.cat([h[..., 0], heights], dim=-1)) - across
        moved = along[..., None] * normal[:, None]
        return (out + moved.flatten(1) @ self.vectors).view_as(x)

    def output_layers(self) -> list[nn.Module]:
        """The maps to what lies across and along the normal."""
        return [self.chunk_out, self.along]


@dataclass(frozen=True)
class SteerableOptions(DenoisingOptions):
    """Options of the policies with irreps."""

    channels: int = 32
    """Irreps of each degree for the observation."""
    width: int = 32
    """Irreps of each degree for the chunk."""
    depth: int = 2
    """Blocks for the chunk."""
    zero_output: bool = True
    """Start the output layer at 0. With random weights in it, these networks hardly learn actions
    that are always 0."""
    symmetry: str = "C8"
    """The group that steering agents may use: a finite group of rotations, C_n."""

    def __post_init__(self) -> None:
        super().__post_init__()
        Group.parse_rotations(self.symmetry)
        if self.network != "mlp":
            raise UserError("a policy with irreps has a network of its own; leave network as it is")


@dataclass(frozen=True)
class PlanarOptions(SteerableOptions):
    """Options of the policy with frequencies of SO(2)."""

    max_frequency: int = 4
    """Highest frequency of the features; a cube's yaw has frequency 4."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_positive("max_frequency")


class PlanarSteerablePolicy(DiffusionPolicy):
    """Diffusion policy with frequencies of SO(2): commutes with every rotation of the plane."""

    name = "so2"
    Options = PlanarOptions
    options: PlanarOptions

    @classmethod
    def hand_group(cls, options: Any) -> Group:
        """That of the agents."""
        return Group.parse_rotations(options.symmetry)

    def make_denoiser(self) -> IrrepDenoiser:
        """The network with planar irreps."""
        irreps = PlanarIrreps(self.options.max_frequency)
        return IrrepDenoiser(irreps, self.options, self.obs_layout, self.chunk_layout)


class SphericalPolicy(DiffusionPolicy):
    """Diffusion policy with irreps of SO(3): commutes with every rotation of space.

    Vectors in space (:meth:`Layout.spatial_vectors`) have one scale and one bound. An observation
    without the table's normal (``normal_xy``, ``normal_z``) is one above a level table: the network
    sees the vertical beside it, so that it commutes with the rotations about the vertical.
    """

    name = "spherical"
    Options = SteerableOptions
    options: SteerableOptions

    @classmethod
    def bounded_layout(cls, layout: Layout) -> Layout:
        """Vectors in space have one norm."""
        return layout.spatial

    @classmethod
    def hand_group(cls, options: Any) -> Group:
        """That of the agents."""
        return Group.parse_rotations(options.symmetry)

    def make_denoiser(self) -> IrrepDenoiser:
        """The network with spatial irreps."""
        if self.options.action_frame:
            raise UserError("an action_frame turns in the plane; the spherical policy has none")
        layout, kind = self.obs_layout, SpatialDenoiser
        if NORMAL not in layout.spatial_vectors():
            layout = Layout([*layout.fields, Field(NORMAL[0], 1), Field(NORMAL[1], 0)])
            kind = LevelDenoiser
        return kind(SpatialIrreps(), self.options, layout, self.chunk_layout)


class LevelDenoiser(SpatialDenoiser):
    """Adds the vertical to an observation above a level table."""

    def encode(self, obs: torch.Tensor) -> torch.Tensor:
        level, up = obs.new_zeros(len(obs), 2), obs.new_ones(len(obs), 1)
        return super().encode(torch.cat([obs, level, up], dim=-1))
