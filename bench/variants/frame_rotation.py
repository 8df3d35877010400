"""The axes of the whole observation are turned: a control."""

from __future__ import annotations

import math

import torch

from symsteer.bench.variants.base import Variant
from symsteer.policies.geometry import Layout


class FrameRotation(Variant):
    """The whole observation is turned by 45 degrees * strength about the vertical axis.

    Actions stay in the world's axes. Rotations of the plane commute with each other, so that the
    observation of a rotated world is still the rotated observation: every C_n remains a symmetry,
    and an equivariant agent has to learn a constant turn, which its networks can express.
    Reflections do not commute with it. This is a control: the audit must find no defect under C_n.
    Breaks the observation, everywhere; rotations survive, reflections do not.
    """

    def observation(self, values: torch.Tensor, layout: Layout) -> torch.Tensor:
        turned = layout.rotate(values, math.radians(45) * self.amount)
        return self.only_active(turned, values)
