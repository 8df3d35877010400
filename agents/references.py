"""References without training: random noise (the base policy as it is) and zero noise."""

from __future__ import annotations

import torch

from symsteer.agents.agent import Agent


class BaseAgent(Agent):
    """w ~ N(0, I), seeded: the frozen policy without steering."""

    name = "base"
    role = "reference"

    def act(self, obs: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """Noise ``[B, Tp, Da]``; random even if ``deterministic``, as the base policy is."""
        return self.gaussian_noise(len(obs))


class ZeroAgent(Agent):
    """w = 0: invariant under the group, so exactly equivariant, and free of cost."""

    name = "zero"
    role = "reference"

    def act(self, obs: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """Zeros ``[B, Tp, Da]``."""
        return torch.zeros(
            len(obs), self.rows, self.act_layout.dim, device=self.device, dtype=self.dtype
        )
