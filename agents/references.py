"""What every learner has to beat, at no cost: the base policy's own noise, and none."""

from __future__ import annotations

import torch

from symsteer.agents.agent import Agent


class BaseAgent(Agent):
    """w ~ N(0, I), seeded: the frozen policy as it is."""

    name = "base"
    role = "reference"

    def act(self, obs: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """Noise ``[B, Tp, Da]``; also random when ``deterministic``, for that is the base."""
        return self.gaussian_noise(len(obs))


class ZeroAgent(Agent):
    """w = 0: fixed by every group element, hence free of cost and exactly equivariant."""

    name = "zero"
    role = "reference"

    def act(self, obs: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """Zeros ``[B, Tp, Da]``."""
        return torch.zeros(
            len(obs), self.horizon, self.act_layout.dim, device=self.device, dtype=self.dtype
        )
