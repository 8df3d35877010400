"""The actuator drifts."""

from __future__ import annotations

import torch

from symsteer.bench.variants.base import Variant


class ActuatorOffset(Variant):
    """Adds 0.3 * strength of a full step along +x to every executed horizontal step.

    At strength 1 that is 9 mm a control step for ``floating`` (full step 30 mm) and a
    command of 30 mm for the ``panda``, whose controller covers about 12 mm of it. It is added
    after the controller's bound, so that it is the same for every action, also for zero.
    Breaks actuation, everywhere; the mirror image in the x axis survives.
    """

    def load_scene(self) -> None:
        self.bias = torch.zeros(self.env.num_envs, 2, device=self.env.device)
        self.strengths_changed()
        self.env.body.set_bias(self.env.agent, self.bias)

    def strengths_changed(self) -> None:
        self.bias[:, 0] = 0.3 * self.amount
