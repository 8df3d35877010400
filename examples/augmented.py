"""Symmetry from data instead of architecture: the plain agent learns from rotated transitions.

If the world is symmetric, a transition (s, w, r, s') rotated as a whole is another true one, with
the same reward. The equivariant agent has this built in. This agent learns it from rotated data,
with a random rotation for every transition of every batch. It costs no more than the plain agent
and is free to leave the symmetry. Where the world breaks the symmetry, some rotated transitions
are false. Does it suffer less than an agent that cannot leave the symmetry?
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from symsteer.agents.replay import Batch
from symsteer.agents.sac import SacOptions
from symsteer.agents.standard import StandardAgent
from symsteer.policies.geometry import Group


@dataclass(frozen=True)
class AugmentedOptions(SacOptions):
    """Options of the augmented agent."""

    augmentation: str = "C8"
    """Group whose rotations turn the transitions of a batch."""

    def __post_init__(self) -> None:
        super().__post_init__()
        _ = Group.parse(self.augmentation).order_of_rotations


class AugmentedAgent(StandardAgent):
    """Plain actor, plain critics, every transition of a batch rotated at random."""

    name = "augmented"
    Options = AugmentedOptions
    options: AugmentedOptions

    def update(self, batch: Batch) -> dict[str, torch.Tensor]:
        """One step on a batch in which each row is rotated by an angle of its own."""
        rotations = Group.parse(self.options.augmentation).order_of_rotations
        # The agent's own generator: its state is in the checkpoint, so a resumed run repeats.
        drawn = torch.randint(
            rotations, (len(batch.obs),), generator=self.generator, device=self.device
        )
        angle = 2 * math.pi / rotations * drawn
        # A layout knows which numbers are planar vectors; the chunk's is Tp actions side by side.
        noise = self.noise_layout.rotate(batch.noise.flatten(1), angle)
        rotated = batch.replace(
            obs=self.obs_layout.rotate(batch.obs, angle),
            noise=noise.view_as(batch.noise),
            next_obs=self.obs_layout.rotate(batch.next_obs, angle),
        )
        return super().update(rotated)
