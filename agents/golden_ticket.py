"""The golden ticket: the best constant noise, found by search on training episodes.

It plays one noise chunk in all states, as in arXiv 2603.15757. The search is sequential halving
(Karnin, Koren and Somekh, ICML 2013): each round plays the remaining candidates on the same initial
states and keeps the better half.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from symsteer.agents.agent import Agent, AgentContext, AgentOptions, Budget, MakeEnv, NoiseEnv
from symsteer.agents.episodes import Played
from symsteer.agents.generators import tensor_like
from symsteer.errors import UserError


@dataclass(frozen=True)
class GoldenTicketOptions(AgentOptions):
    """Options of the golden ticket."""

    candidates: int = 64
    """Candidates of the first round; fewer if the budget is too small for them."""

    def __post_init__(self) -> None:
        if self.candidates < 2:
            raise UserError(f"agent option candidates must be at least 2, not {self.candidates}")


class GoldenTicketAgent(Agent):
    """Plays the best constant noise of a search on training episodes."""

    name = "golden-ticket"
    role = "reference"
    Options = GoldenTicketOptions
    options: GoldenTicketOptions

    def __init__(self, context: AgentContext, options: GoldenTicketOptions | None = None):
        super().__init__(context, options)
        shape = (self.rows, self.act_layout.dim)
        self.ticket = torch.zeros(shape, device=self.device, dtype=self.dtype)
        self.searched: dict[str, float | None] = {}

    @classmethod
    def check(cls, options: GoldenTicketOptions, budget: Budget) -> None:
        """Check that the budget is enough for two candidates."""
        rounds(budget, options.candidates)

    def prepare(self, make_env: MakeEnv, budget: Budget) -> int:
        """Search with the whole budget. The score is the mean return; on ties, the first wins."""
        sizes = rounds(budget, self.options.candidates)
        env = make_env(True)
        left = self.gaussian_noise(sizes[0])
        left[0] = 0  # zero is free, so it is always among the candidates
        batch = env.num_envs * env.max_episode_steps
        for number, size in enumerate(sizes):
            batches = max(-(-size // env.num_envs), budget.env_steps // len(sizes) // batch)
            starts = max(1, batches * env.num_envs // size)
            seeds = [seed for seed in env.training_seeds(number, starts) for _ in range(size)]
            played = play_constant(env, left.repeat(starts, 1, 1), seeds)
            score, success = (
                played[name].double().view(starts, size).mean(0)
                for name in ("return", "success_once")
            )
            order = score.argsort(descending=True, stable=True)
            self.ticket = left[order[0]]
            self.searched = {
                "ticket_success": success[order[0]].item(),
                "ticket_episodes": float(starts),
                "ticket_candidates": float(sizes[0]),
            }
            left = left[order[: size // 2].sort().values]
        return 0

    def act(self, obs: torch.Tensor, deterministic: bool = False) -> torch.Tensor:
        """The ticket for every observation, ``[B, Tp, Da]``."""
        return self.ticket.expand(len(obs), *self.ticket.shape).clone()

    def diagnostics(self, played: Played) -> Mapping[str, float | None]:
        """Root mean square of the ticket (about 1 for N(0, I)), and numbers of the search."""
        return {"ticket_rms": self.ticket.square().mean().sqrt().item(), **self.searched}

    def state_dict(self) -> dict[str, Any]:
        """The generator, the ticket and the numbers of the search."""
        return {**super().state_dict(), "ticket": self.ticket.clone(), "searched": self.searched}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue with the ticket."""
        super().load_state_dict(state)
        self.ticket = tensor_like(state["ticket"], self.ticket)
        self.searched = {str(name): float(value) for name, value in state["searched"].items()}


def play_constant(env: NoiseEnv, noise: torch.Tensor, seeds: list[int]) -> dict[str, torch.Tensor]:
    """Play one whole episode for each row of ``noise [M, Tp, Da]`` from ``seeds`` (M of them).

    Returns:
        ManiSkill's metrics of the episodes, each ``[M]``.
    """
    batches = []
    for start in range(0, len(seeds), env.num_envs):
        # If the last batch is not full, the other environments repeat a row and are dropped.
        rows = torch.arange(start, start + env.num_envs).clamp(max=len(seeds) - 1)
        env.reset([seeds[int(row)] for row in rows])
        for _ in range(math.ceil(env.max_episode_steps / env.execute)):
            step = env.step(noise[rows])
        # All episodes end with the last decision, so the rows are the environments in order.
        keep = min(env.num_envs, len(seeds) - start)
        batches.append({name: value[:keep] for name, value in step.episodes.items()})
    return {name: torch.cat([batch[name] for batch in batches]) for name in batches[0]}


def rounds(budget: Budget, candidates: int) -> list[int]:
    """Number of candidates in every round, limited by the budget.

    Raises:
        UserError: if the budget is not enough for two candidates.
    """
    batch = budget.num_envs * budget.max_episode_steps
    while candidates >= 2:
        sizes = [candidates >> i for i in range(int(math.log2(candidates)))]
        share = budget.env_steps // len(sizes) // batch
        if all(share >= -(-size // budget.num_envs) for size in sizes):
            return sizes
        candidates //= 2
    raise UserError(
        f"env_steps is {budget.env_steps}; a search of the best constant noise needs at least "
        f"{batch}, one episode of {budget.max_episode_steps} steps in each of {budget.num_envs} "
        "environments: raise env_steps or lower num_envs"
    )
