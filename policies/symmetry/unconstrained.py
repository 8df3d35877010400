"""No symmetry: the plain diffusion policy, the control of the equivariant one.

It is the lifted network over the trivial group C1: one slice, ordinary dense layers, the same code.
By default it is as large as the equivariant policy that it is compared with and trains for about
as long.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Self, TypeVar

import torch

from symsteer.policies.geometry import Group, Layout
from symsteer.policies.networks.denoiser import parameter_count
from symsteer.policies.symmetry.lifted import LiftedDenoiser
from symsteer.policies.training.denoising import DenoisingOptions, DiffusionPolicy

TRIVIAL = "C1"


P = TypeVar("P", bound=DenoisingOptions)


@dataclass(frozen=True)
class PlainOptions(DenoisingOptions):
    """Options of the plain diffusion policy."""

    group: str = "C8"
    """Group of the equivariant policy whose size and training time are matched; C1: none. Once
    matched, a policy's own options say C1."""
    match_parameters: bool = True
    """Widen the network until it has as many parameters as the equivariant one."""
    match_compute: bool = True
    """Train for more steps, order/2 times as many (C8: 4 times). This takes about as long as the
    slices of the equivariant policy."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = Group.parse(self.group).order

    def resolved(self, obs_layout: Layout, act_layout: Layout) -> Self:
        """Options with size and steps filled in, and the group C1."""
        group = Group.parse(self.group)
        if self.group == TRIVIAL:
            return self
        options = dataclasses.replace(self, group=TRIVIAL)
        if self.match_compute:
            # Measured at the default sizes: a step over 8 slices costs 3 to 4 plain steps.
            options = dataclasses.replace(options, steps=self.steps * max(1, group.order // 2))
        if self.match_parameters:
            options = matched_size(options, obs_layout, act_layout, group)
        return options


class PlainDiffusionPolicy(DiffusionPolicy):
    """Plain diffusion policy, as large as the equivariant one and trained for as long."""

    name = "plain"
    Options = PlainOptions
    options: PlainOptions

    @classmethod
    def picture_group(cls, options: Any) -> Group:
        """The trivial one."""
        return Group.parse(TRIVIAL)

    def make_denoiser(self) -> LiftedDenoiser:
        """The same network over the trivial group."""
        group = Group.parse(TRIVIAL)
        return LiftedDenoiser(self.options, self.obs_layout, self.chunk_layout, group)


def matched_size(options: P, obs_layout: Layout, act_layout: Layout, group: Group) -> P:
    """Options of the plain network whose number of parameters comes closest to ``group``'s.

    Channels and width grow together, in steps of 4 features; depth and horizon stay.
    """

    def count(options: DenoisingOptions, group: Group) -> int:
        with torch.device("meta"):
            return parameter_count(LiftedDenoiser(options, obs_layout, act_layout, group))

    channels, width = options.channels, options.width
    target = count(options, group)
    best: tuple[int, P] | None = None
    for plain_width in range(width - width % 4, 8 * width + 1, 4):
        plain_channels = max(4, round(channels * plain_width / width / 4) * 4)
        plain = dataclasses.replace(options, channels=plain_channels, width=plain_width)
        size = count(plain, Group.parse(TRIVIAL))
        if best is None or abs(size - target) < best[0]:
            best = (abs(size - target), plain)
        if size > target:
            break
    assert best is not None
    return best[1]
