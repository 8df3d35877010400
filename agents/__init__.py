"""Steering agents: SAC in the latent noise of a frozen policy, and the references it must beat."""

from __future__ import annotations

from typing import Any, Protocol

import torch

from agents.approximate import ApproximateAgent
from agents.equivariant import EquivariantAgent
from agents.references import BaseAgent, ZeroAgent
from agents.replay import Batch, ReplayBuffer
from agents.sac import Normalize, SacAgent, SacConfig
from agents.standard import MatchedStandardAgent, StandardAgent
from policies.errors import UserError
from policies.geometry import Layout

__all__ = [
    "AGENTS",
    "Batch",
    "ReplayBuffer",
    "SacAgent",
    "SacConfig",
    "SteeringAgent",
    "make_agent",
]

AGENTS: dict[str, type[SacAgent] | type[BaseAgent]] = {
    agent.name: agent
    for agent in (
        StandardAgent,
        MatchedStandardAgent,
        EquivariantAgent,
        ApproximateAgent,
        BaseAgent,
        ZeroAgent,
    )
}


class SteeringAgent(Protocol):
    """What the collecting loop needs of an agent."""

    name: str
    learns: bool

    def act(self, obs: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """Noise ``[B, Tp, Da]`` for observations ``[B, obs_dim]``."""
        ...

    def update(self, batch: Batch) -> dict[str, torch.Tensor]:
        """One gradient step; scalars as tensors (none if the agent does not learn)."""
        ...

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: dict[str, Any]) -> None: ...

    def parameter_counts(self) -> dict[str, int]:
        """Keys actor, critic, total, actor_width, critic_width."""
        ...


def make_agent(
    name: str,
    obs_layout: Layout,
    act_layout: Layout,
    horizon: int,
    config: SacConfig | None = None,
    device: torch.device | str = "cpu",
    seed: int = 0,
    normalize_obs: Normalize | None = None,
    dtype: torch.dtype = torch.float32,
) -> SacAgent | BaseAgent:
    """Build an agent by name; arguments as in :class:`agents.sac.SacAgent`.

    Raises:
        UserError: if there is no agent of that name.
    """
    if name not in AGENTS:
        raise UserError(f"there is no agent {name!r}; choose one of {', '.join(AGENTS)}")
    return AGENTS[name](
        obs_layout, act_layout, horizon, config or SacConfig(), device, seed, normalize_obs, dtype
    )
