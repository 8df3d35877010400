"""The equivariant agent on a leash: its actor also pays for the size of its noise.

w = 0 is the one noise that every symmetry of the scene leaves where it is, and where an untrained
actor starts. This agent leaves it only where the critics promise more than ``leash * |w|^2``. Does
it exploit errors of the critics less than an agent that may go as far as the bound? Rotations and
reflections do not change |w|^2, so the agent stays exactly equivariant.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch

from symsteer import UserError
from symsteer.agents import Batch, EquivariantAgent, SacOptions


@dataclass(frozen=True)
class LeashedOptions(SacOptions):
    """Options of the leashed agent."""

    leash: float = 0.01
    """Weight of |w|^2 in the actor's loss."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.leash >= 0:
            raise UserError(f"agent option leash must not be negative, not {self.leash}")


class LeashedAgent(EquivariantAgent):
    """Equivariant actor and critics; the actor also pays for noise far from zero."""

    name = "leashed"
    Options = LeashedOptions
    options: LeashedOptions

    def actor_loss(
        self, q: torch.Tensor, noise: torch.Tensor, log_prob: torch.Tensor, batch: Batch
    ) -> torch.Tensor:
        """SAC's loss and the weighted squared norm of the actor's noise ``[B, Tp * Da]``."""
        loss = super().actor_loss(q, noise, log_prob, batch)
        return loss + self.options.leash * noise.square().sum(1).mean()
