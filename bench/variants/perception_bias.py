"""The camera that sees the objects is off."""

from __future__ import annotations

import torch
from mani_skill.utils.structs import Pose

from symsteer.bench.variants.base import Role, Variant


class PerceptionBias(Variant):
    """Objects are reported 2 cm * strength too far along +x; tool and goal are exact.

    As with a badly calibrated camera. What the observation derives from positions (vectors from
    the tool to an object, from an object to the goal) is off by the same vector.
    Breaks the observation, everywhere; the mirror image in the x axis survives.
    """

    def perceive(self, pose: Pose, role: Role) -> Pose:
        if role != "object":
            return pose
        return self.moved(pose, torch.stack([0.02 * self.amount, 0 * self.amount], dim=1))
