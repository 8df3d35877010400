"""The actuator drifts."""

from __future__ import annotations

import torch

from symsteer.bench.variants.base import Variant


class ActuatorOffset(Variant):
    """Adds 0.3 * strength of a full step along +x to every executed horizontal step.

    At strength 1 that is 9 mm a control step for ``floating`` (full step 30 mm) and 30 mm asked of
    the ``panda``, whose controller covers about 12 of them. It is added behind the controller's
    bound, so that it is the same for every action, full ones included; an action of zero drifts.
    Breaks actuation, everywhere; the mirror image in the x axis survives.
    """

    def load_scene(self) -> None:
        along = 0.3 * self.amount
        bias = torch.stack([along, torch.zeros_like(along)], dim=1)
        self.env.body.set_bias(self.env.agent, bias)
