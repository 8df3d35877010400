"""Symmetry from data instead of architecture: the plain agent learns from rotated transitions.

If the world is symmetric, a transition (s, w, r, s') rotated as a whole is another true one, with
the same reward. The equivariant agent has this built in; this one is told, with a fresh rotation
for every transition of every batch. It is the classical rival of equivariant networks: as cheap to
run as the plain agent, and free to forget what it was told. Where the world breaks the symmetry,
some of what it is told is false. Does it suffer less than an agent that cannot leave the symmetry?
"""

from __future__ import annotations

import math

import torch

from symsteer.agents.replay import Batch
from symsteer.agents.standard import StandardAgent
from symsteer.policies.geometry import Group


class AugmentedAgent(StandardAgent):
    """Plain actor, plain critics, every batch rotated by random elements of ``config.group``."""

    name = "augmented"

    def update(self, batch: Batch) -> dict[str, torch.Tensor]:
        """One step on a batch of which each row was turned by an angle of its own."""
        rotations = Group.parse(self.config.group).order_of_rotations
        # The agent's own generator, whose state is in the checkpoint: a resumed run repeats.
        draw = torch.randint(
            rotations, (len(batch.obs),), generator=self.generator, device=self.device
        )
        angle = 2 * math.pi / rotations * draw
        # A layout knows which numbers are planar vectors; the chunk's is Tp actions side by side.
        noise = self.noise_layout.rotate(batch.noise.flatten(1), angle)
        turned = batch._replace(
            obs=self.obs_layout.rotate(batch.obs, angle),
            noise=noise.view_as(batch.noise),
            next_obs=self.obs_layout.rotate(batch.next_obs, angle),
        )
        return super().update(turned)
