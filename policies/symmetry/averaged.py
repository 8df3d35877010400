"""Symmetry by averaging over the group (frame averaging, arXiv 2106.03487; in policies 2505.13431).

    Psi(x, s, t) = mean_g rho_a(g) Phi(rho_a(g)^-1 x, rho_s(g)^-1 s, t)

for any network Phi that predicts a chunk: exact, with as many calls of Phi as the group has
elements, in training and in decoding. The lifted network is the special case of a Phi whose first
layers are linear, if the group convolution of its observation embedding is left out.
"""

from __future__ import annotations

import copy
import dataclasses
from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import nn

from symsteer.policies.geometry import Group, Layout
from symsteer.policies.networks.denoiser import Denoiser
from symsteer.policies.networks.in_hand import AveragedHandEncoder
from symsteer.policies.symmetry.lifted import EquivariantOptions, LiftedDenoiser
from symsteer.policies.symmetry.unconstrained import TRIVIAL, matched_size
from symsteer.policies.training.denoising import DiffusionPolicy


class AveragedDenoiser(Denoiser):
    """The average of any denoiser over a finite group.

    Args:
        inner: needs no symmetry; it sees batches that are ``order`` times as large.
        obs_layout: geometry of an observation.
        act_layout: geometry of an action.
        group: a finite group.
    """

    def __init__(self, inner: Denoiser, obs_layout: Layout, act_layout: Layout, group: Group):
        super().__init__()
        self.inner, self.group = inner, group
        self.layouts = obs_layout, act_layout

    def encode(self, obs: torch.Tensor) -> torch.Tensor:
        """What the inner network sees of all copies, ``[order * B, ...]``."""
        return self.inner.encode(self._turned_back(obs, self.layouts[0]))

    def encode_time(self, t: torch.Tensor) -> torch.Tensor:
        """As the inner network."""
        return self.inner.encode_time(t)

    def forward(self, x: torch.Tensor, context: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
        """Predict; see :meth:`Denoiser.forward`."""
        if len(time) > 1:
            time = time.repeat(self.group.order, *(1,) * (time.dim() - 1))
        out = self.inner(self._turned_back(x, self.layouts[1]), context, time)
        copies = out.unflatten(0, (self.group.order, len(x)))
        rho = self.group.representation(self.layouts[1], x.dtype, x.device)
        return torch.einsum("gij,gb...j->b...i", rho, copies) / self.group.order

    def output_layers(self) -> list[nn.Module]:
        """Those of the inner network."""
        return self.inner.output_layers()

    def expanded(self) -> Self:
        """A copy around the inner network's own."""
        fast = copy.copy(self)
        fast._modules = {"inner": self.inner.expanded()}
        return fast

    def _turned_back(self, x: torch.Tensor, layout: Layout) -> torch.Tensor:
        """All copies rho(g)^-1 x of ``x [B, ...]``, ``[order * B, ...]``."""
        rho = self.group.representation(layout, x.dtype, x.device)
        return torch.einsum("gij,b...i->gb...j", rho, x).flatten(0, 1)


@dataclass(frozen=True)
class AveragedOptions(EquivariantOptions):
    """Options of the frame-averaged diffusion policy."""

    match_parameters: bool = True
    """Widen the network inside until it has as many parameters as the lifted one."""

    def resolved(self, obs_layout: Layout, act_layout: Layout) -> Self:
        """Options with the size filled in."""
        if not self.match_parameters:
            return self
        sized = matched_size(self, obs_layout, act_layout, Group.parse(self.group))
        return dataclasses.replace(sized, match_parameters=False)


class FrameAveragedDiffusionPolicy(DiffusionPolicy):
    """A plain diffusion network, averaged over the group."""

    name = "frame-averaged"
    Options = AveragedOptions
    options: AveragedOptions
    hand_encoder = AveragedHandEncoder

    @classmethod
    def hand_group(cls, options: Any) -> Group:
        """That of the options."""
        return Group.parse_rotations(options.group)

    def make_denoiser(self) -> AveragedDenoiser:
        """The average of :meth:`make_inner`."""
        group = Group.parse(self.options.group)
        return AveragedDenoiser(self.make_inner(), self.obs_layout, self.chunk_layout, group)

    def make_inner(self) -> Denoiser:
        """The network that is averaged, untrained; a subclass may take any other one."""
        trivial = Group.parse(TRIVIAL)
        return LiftedDenoiser(self.options, self.obs_layout, self.chunk_layout, trivial)
