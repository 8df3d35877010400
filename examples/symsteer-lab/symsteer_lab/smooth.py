"""An agent whose decoded actions change little from one step to the next.

The actor's loss of SAC (arXiv 1812.05905) gets one more term, ``smoothness * roughness``: the mean
squared difference of successive actions in the chunk that the frozen policy decodes from the
actor's noise. Its gradient runs through the decoder. The term is a sum of squared norms, which
rotations do not change, so the actor stays equivariant.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from symsteer import UserError
from symsteer.agents import Batch, Budget, EquivariantAgent, SacOptions


@dataclass(frozen=True)
class SmoothOptions(SacOptions):
    """Options of the smooth agent."""

    smoothness: float = 0.1
    """Weight of the roughness of the decoded chunk in the actor's loss."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.smoothness >= 0:
            raise UserError(f"agent option smoothness must not be negative, not {self.smoothness}")


class SmoothAgent(EquivariantAgent):
    """Equivariant actor and critics; the actor also pays for jumps between successive actions."""

    name = "smooth"
    Options = SmoothOptions
    options: SmoothOptions

    @classmethod
    def check(cls, options: SmoothOptions, budget: Budget) -> None:
        """Refuse chunks of which only one action is executed."""
        super().check(options, budget)
        if budget.execute < 2:
            raise UserError(
                "the agent 'smooth' compares successive actions; raise policy.execute to 2 or more"
            )

    def actor_loss(
        self, q: torch.Tensor, noise: torch.Tensor, log_prob: torch.Tensor, batch: Batch
    ) -> torch.Tensor:
        """SAC's loss and the weighted roughness of the decoded chunk."""
        decoded = roughness(self.context.decode(batch.obs, self.chunk(noise)))
        self.decoded_roughness = decoded.detach()
        loss = super().actor_loss(q, noise, log_prob, batch)
        return loss + self.options.smoothness * decoded

    def after_update(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Roughness of the actor's chunks, and of what was executed."""
        return {
            "train/roughness": self.decoded_roughness,
            "train/executed_roughness": roughness(batch.actions),
        }


def roughness(actions: torch.Tensor) -> torch.Tensor:
    """Mean squared difference of successive actions ``[B, T, Da]``, a scalar; T >= 2."""
    return actions.diff(dim=1).square().mean()
