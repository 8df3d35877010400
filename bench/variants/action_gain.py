"""One horizontal axis of the actuator is weak."""

from __future__ import annotations

import torch

from symsteer.bench.variants.base import Variant


class ActionGain(Variant):
    """Scales the executed x displacement by 1 - 0.6 * strength; y is unchanged.

    Strength 1 leaves 40 % of each commanded step along x, as a badly calibrated or overloaded
    axis would; 0.5 leaves 70 %. It acts after the action has been bounded, so that a larger
    command cannot compensate for it within a step. Breaks actuation, everywhere; reflections
    about the x and y axes and the half turn survive.
    """

    def action(self, action: torch.Tensor) -> torch.Tensor:
        x = self.env.action_layout.slice("xy").start
        gain = 1.0 - 0.6 * self.amount
        executed = action.clone()
        executed[:, x] = action[:, x] * gain
        return executed
