"""Symmetry by a canonical frame (after CanonFlow, arXiv 2602.15022, with a condition).

    angle of an observed vector (the anchor) -> observation and noise turned back by it
    -> plain policy -> chunk turned forward

The policy commutes with every rotation of the plane, not with those of a finite group alone, and
with no reflection. Where the anchor vanishes its angle jumps, and the policy with it: no continuous
choice of a frame exists there. By default the anchor is the vector that stays longest in the
demonstrations. CanonFlow has no condition and takes its frame from the data; the frame from the
observation is our choice.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch

from symsteer.policies.contract import Episode
from symsteer.policies.geometry import Group, Layout
from symsteer.policies.networks.in_hand import AveragedHandEncoder
from symsteer.policies.symmetry.unconstrained import PlainDiffusionPolicy, PlainOptions
from symsteer.policies.training.frames import Frame, planar_vectors

SHORT = 0.01
"""An anchor is judged by this quantile of its length in the demonstrations."""


@dataclass(frozen=True)
class CanonicalOptions(PlainOptions):
    """Options of the canonical diffusion policy."""

    anchor: str = ""
    """A vector of the observation; its angle defines the frame. Default: the vector whose shortest
    demonstrated lengths are largest, relative to its longest one."""
    symmetry: str = "C8"
    """The group that steering agents may use: a finite group of rotations, C_n."""

    def __post_init__(self) -> None:
        super().__post_init__()
        Group.parse_rotations(self.symmetry)


class CanonicalDiffusionPolicy(PlainDiffusionPolicy):
    """Plain diffusion policy in a frame that turns with the observation."""

    name = "canonical"
    Options = CanonicalOptions
    options: CanonicalOptions
    hand_encoder = AveragedHandEncoder

    def __init__(self, options: CanonicalOptions, obs_layout: Layout, act_layout: Layout):
        if not options.anchor:
            options = dataclasses.replace(options, anchor=planar_vectors(obs_layout)[0].name)
        super().__init__(options, obs_layout, act_layout)
        self.anchor = Frame(options.anchor, self.obs_layout, act_layout)
        self.group = Group.parse(options.symmetry)

    @classmethod
    def picture_group(cls, options: Any) -> Group:
        """It has none: what a picture from above tells does not turn with an observed vector."""
        return super(PlainDiffusionPolicy, cls).picture_group(options)

    @classmethod
    def hand_group(cls, options: Any) -> Group:
        """That of the agents."""
        return Group.parse_rotations(options.symmetry)

    @classmethod
    def told_by_data(cls, options: Any, episodes: Sequence[Episode], obs_layout: Layout) -> Any:
        """With the anchor."""
        if options.anchor:
            return options
        seen = torch.cat([obs for obs, _ in episodes])
        return dataclasses.replace(options, anchor=steadiest_vector(seen, obs_layout))

    def augment(
        self, obs: torch.Tensor, chunks: torch.Tensor, generator: torch.Generator
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Turn each pair of observation and chunk into its frame."""
        # An encoder of pictures comes later.
        anchor = Frame(self.options.anchor, self.task_layout, self.act_layout)
        angle = self._angle(obs, anchor)
        return self.task_layout.rotate(obs, -angle), self.act_layout.rotate(chunks, -angle)

    def decode(self, obs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """Decode in the frame of the anchor; see :meth:`ChunkPolicy.decode`."""
        angle = self._angle(obs, self.anchor)
        turned = self.obs_layout.rotate(obs, -angle), self.act_layout.rotate(noise, -angle)
        return self.act_layout.rotate(super().decode(*turned), angle)

    def decode_settings(self) -> dict[str, Any]:
        """Also the anchor."""
        return {**super().decode_settings(), "anchor": self.options.anchor}

    @staticmethod
    def _angle(obs: torch.Tensor, anchor: Frame) -> torch.Tensor:
        angle = anchor.angle(obs)
        assert angle is not None
        return angle


def steadiest_vector(obs: torch.Tensor, layout: Layout) -> str:
    """The planar vector of ``obs [M, obs_dim]`` that stays away from 0, by name.

    Raises:
        UserError: if the layout has no planar vector.
    """
    shortest: dict[str, float] = {}
    for field in planar_vectors(layout):
        length = obs[:, layout.slice(field.name)].float().norm(dim=-1)
        shortest[field.name] = (length.quantile(SHORT) / length.max().clamp(min=1e-12)).item()
    return max(shortest, key=lambda name: shortest[name])
