"""An actuator that loses small steps in one direction."""

from __future__ import annotations

import torch

from symsteer.bench import Variant


class DeadZone(Variant):
    """Steps along -x lose their first part, 0.4 * strength of a full step.

    A commanded x displacement of -u (in full steps, 0 <= u <= 1) is executed as
    -max(u - 0.4 * strength, 0); displacements along +x and y are unchanged. At strength 1, steps
    along -x that are shorter than 0.4 of a full step do nothing, as with a worn gear. Breaks
    actuation, everywhere; the mirror image in the x axis survives.
    """

    def action(self, action: torch.Tensor) -> torch.Tensor:
        x = self.env.action_layout.slice("xy").start
        commanded = action[:, x]
        executed = action.clone()
        shortened = (commanded + 0.4 * self.amount).clamp(max=0.0)
        executed[:, x] = torch.where(commanded < 0, shortened, commanded)
        return executed
