"""An encoder of clouds of points that commutes with the group and with every order of the points.

A shared network sees each point, together with the rest of the observation; the largest value over
the points is kept (PointNet, arXiv 1612.00593). In regular fields the group permutes components, so
that a maximum of each component commutes with it.
"""

from __future__ import annotations

import copy
from typing import Self

import torch
from torch import nn
from torch.nn import functional

from symsteer.policies.geometry import Group, Layout
from symsteer.policies.networks.equivariant import ExpandedLayer, Lift, RegularLinear

CHANNELS = 16
"""Regular fields of a point."""


class PointEncoder(nn.Module):
    """Points, and what is known beside them, to regular fields.

    Args:
        layout: geometry of one point.
        group: a finite group.
        channels: regular fields of what is known, and of the result.
    """

    def __init__(self, layout: Layout, group: Group, channels: int):
        super().__init__()
        self.group = group
        self.lift: nn.Module = Lift(layout, group, CHANNELS)
        self.known: nn.Module = RegularLinear(group, channels, CHANNELS)
        self.mix: nn.Module = RegularLinear(group, CHANNELS, CHANNELS)
        self.out: nn.Module = RegularLinear(group, CHANNELS, channels)

    def forward(self, points: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
        """Encode; ``points [B, P, dim]``, ``known [B, order, c]`` -> ``[B, order, c]``."""
        hidden = functional.silu(self.lift(points) + self.known(known)[:, None])
        return self.out(functional.silu(self.mix(hidden)).amax(dim=1))

    def expanded(self) -> Self:
        """A copy for inference whose layers hold their dense matrices ready."""
        fast = copy.deepcopy(self)
        for name in ("lift", "known", "mix", "out"):
            fast.register_module(name, ExpandedLayer(getattr(self, name)))
        return fast
