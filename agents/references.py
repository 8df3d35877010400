"""References without training: random noise (the base policy as it is) and zero noise."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from symsteer.agents.agent import Agent
from symsteer.agents.episodes import Played
from symsteer.policies.sides import sides


class BaseAgent(Agent):
    """w ~ N(0, I), seeded: the frozen policy without steering."""

    name = "base"
    role = "reference"

    def act(self, obs: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """Noise ``[B, Tp, Da]``; random even if ``deterministic``, as the base policy is."""
        return self.gaussian_noise(len(obs))

    def diagnostics(self, played: Played) -> Mapping[str, float | None]:
        """Whether episodes look the same on all sides, and drift (`symsteer.policies.sides`)."""
        seen = played.greedy
        at, episodes = seen.running.nonzero(as_tuple=True)
        obs, noise = seen.obs[at, episodes], seen.noise[at, episodes]
        actions = self.decode(obs, noise)[:, : self.context.execute]
        found = sides(
            *(self.obs_layout, self.act_layout, obs, actions, seen.next_obs[at, episodes]),
            *(episodes, played.generator),
        )
        return {
            "direction_p": found.direction,
            "axis_p": found.axis,
            "drift_x": found.drift.real,
            "drift_y": found.drift.imag,
        }


class ZeroAgent(Agent):
    """w = 0: invariant under the group, so exactly equivariant, and free of cost."""

    name = "zero"
    role = "reference"

    def act(self, obs: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """Zeros ``[B, Tp, Da]``."""
        return torch.zeros(
            len(obs), self.rows, self.act_layout.dim, device=self.device, dtype=self.dtype
        )
