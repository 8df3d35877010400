"""Some directions cost more than others."""

from __future__ import annotations

import torch

from symsteer.bench.variants.base import Variant


class DirectionalReward(Variant):
    """Moving the tool towards +x costs up to ``strength`` a step beside the usual 1.

    The extra cost is strength * d / full step for a displacement d > 0 of the tool centre point
    along +x in a control step (at most strength; nothing at rest or towards -x), until success.
    ``env.step`` reports it as ``info["extra_cost"]`` and subtracts it from ManiSkill's reward; a
    steering agent is paid -(1 + extra cost) a step. Success rates do not
    include it.
    Breaks the reward only, everywhere; the mirror image in the x axis survives.
    """

    def extra_cost(self, moved: torch.Tensor) -> torch.Tensor:
        return self.amount * (moved[:, 0] / self.env.body.horizontal_step).clamp(0, 1)

    @property
    def highest_cost(self) -> float:
        return float(torch.as_tensor(self.strength).max())
