"""The policy uses a wrong centre of the workspace."""

from __future__ import annotations

import torch
from mani_skill.utils.structs import Pose

from symsteer.bench.variants.base import Role, Variant


class FrameOffset(Variant):
    """All positions are reported relative to a point 5 cm * strength from the centre along +x.

    A policy that is equivariant about its origin is then equivariant about that point. On a
    homogeneous table world and observation are as symmetric about it as about the true centre;
    only where episodes begin is not. Heights, directions and relative vectors are unchanged.
    Breaks the initial states, everywhere; the mirror image in the x axis survives.
    """

    def origin(self) -> torch.Tensor:
        return torch.stack([0.05 * self.amount, torch.zeros_like(self.amount)], dim=1)

    def perceive(self, pose: Pose, role: Role) -> Pose:
        return self.moved(pose, -self.origin())
