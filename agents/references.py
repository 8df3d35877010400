"""What every learner has to beat: the base policy's own noise, none, and the best constant one."""

from __future__ import annotations

from typing import Any, ClassVar

import torch

from symsteer.agents.replay import Batch
from symsteer.agents.sac import Normalize, SacConfig, check_description
from symsteer.policies.geometry import Layout


class BaseAgent:
    """w ~ N(0, I), seeded: the frozen policy as it is. Also plays the warm-up.

    It takes the learners' arguments, so that one call makes any agent.
    """

    name: ClassVar[str] = "base"
    learns: ClassVar[bool] = False
    searches: ClassVar[bool] = False
    """Whether the run has to search something before the agent can act."""

    def __init__(
        self,
        obs_layout: Layout,
        act_layout: Layout,
        horizon: int,
        config: SacConfig,
        device: torch.device | str = "cpu",
        seed: int = 0,
        normalize_obs: Normalize | None = None,
        dtype: torch.dtype = torch.float32,
    ):
        self.obs_layout, self.act_layout, self.horizon = obs_layout, act_layout, horizon
        self.config, self.device, self.dtype = config, torch.device(device), dtype
        self.generator = torch.Generator(device=self.device).manual_seed(seed)

    def act(self, obs: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """Noise ``[B, Tp, Da]``; random also when ``deterministic``, for that is the base."""
        return torch.randn(
            self._shape(obs), generator=self.generator, device=self.device, dtype=self.dtype
        )

    def update(self, batch: Batch) -> dict[str, torch.Tensor]:
        """Nothing to learn."""
        return {}

    def scalars(self) -> dict[str, float | None]:
        """What an evaluation reports of the agent itself."""
        return {}

    def parameter_counts(self) -> dict[str, int]:
        """All zero."""
        return dict.fromkeys(("actor", "critic", "total", "actor_width", "critic_width"), 0)

    def description(self) -> dict[str, Any]:
        """What a checkpoint must agree with."""
        return {
            "agent": self.name,
            "obs_layout": self.obs_layout.to_json(),
            "act_layout": self.act_layout.to_json(),
            "horizon": self.horizon,
        }

    def state_dict(self) -> dict[str, Any]:
        """The generator."""
        return {"description": self.description(), "generator": self.generator.get_state()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue the generator.

        Raises:
            UserError: if the checkpoint is of another agent or layout.
        """
        check_description(self.description(), state.get("description", {}))
        self.generator.set_state(state["generator"].cpu())

    def _shape(self, obs: torch.Tensor) -> tuple[int, int, int]:
        return len(obs), self.horizon, self.act_layout.dim


class ZeroAgent(BaseAgent):
    """w = 0: fixed by every group element, hence free of cost and exactly equivariant."""

    name = "zero"

    def act(self, obs: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """Zeros ``[B, Tp, Da]``."""
        return torch.zeros(self._shape(obs), device=self.device, dtype=self.dtype)


class GoldenTicketAgent(BaseAgent):
    """One constant noise for all states, found by search on training episodes.

    After arXiv 2603.15757; ``bench/steering/search.py`` searches. Until then the noise is 0.
    """

    name = "golden-ticket"
    searches = True

    def __init__(self, *args: Any, **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.ticket = torch.zeros(
            self.horizon, self.act_layout.dim, device=self.device, dtype=self.dtype
        )
        self.searched: dict[str, float | None] = {}

    def candidates(self, count: int) -> torch.Tensor:
        """Noise ``[count, Tp, Da]`` to search in: zero first, for it is free, then N(0, I)."""
        drawn = torch.randn(
            count,
            *self.ticket.shape,
            generator=self.generator,
            device=self.device,
            dtype=self.dtype,
        )
        drawn[0] = 0
        return drawn

    def act(self, obs: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """The ticket for every observation, ``[B, Tp, Da]``."""
        return self.ticket.expand(self._shape(obs)).clone()

    def scalars(self) -> dict[str, float | None]:
        """The ticket's root mean square (of N(0, I): about 1), and what the search said of it."""
        return {"ticket_rms": self.ticket.square().mean().sqrt().item(), **self.searched}

    def state_dict(self) -> dict[str, Any]:
        """The generator, the ticket and the search's numbers."""
        return {**super().state_dict(), "ticket": self.ticket.clone(), "searched": self.searched}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue with the ticket.

        Raises:
            UserError: if the checkpoint is of another agent or layout.
        """
        super().load_state_dict(state)
        self.ticket = state["ticket"].to(self.ticket)
        self.searched = dict(state["searched"])
