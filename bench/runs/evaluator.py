"""Held-out episodes of an agent, and what its Q-values are worth there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from symsteer.bench.runs.config import RunConfig
from symsteer.bench.steering.diagnostics import OnPolicy, measure
from symsteer.bench.steering.evaluation import HELD_OUT_SEED, Rollout, held_out_seeds, rollout
from symsteer.bench.steering.latent_env import LatentNoiseEnv
from symsteer.bench.tasks import make
from symsteer.policies.contract import ChunkPolicy

DIAGNOSTIC_SEED = HELD_OUT_SEED + 500_000
"""On-policy episodes for the bias of Q start here: held out, and apart from the reported ones."""


def make_env(
    config: RunConfig,
    base: ChunkPolicy,
    num_envs: int,
    variant: str,
    ignore_terminations: bool,
    workers: int,
) -> LatentNoiseEnv:
    """The latent-noise environment of a run's task."""
    env = make(
        config.task,
        num_envs=num_envs,
        embodiment=config.embodiment,
        variant=variant,
        sim=config.sim,
        workers=min(workers, num_envs),
    )
    return LatentNoiseEnv(env, base, ignore_terminations)


class Evaluator:
    """Plays the held-out episodes and measures the diagnostics; leaves the agent as it was.

    Args:
        config: the run.
        base: the frozen policy.
        feasible: lowest and highest return that the reward allows, per decision.
        learns: whether the agent has a critic to diagnose.
        variant: how the world is broken in these episodes.
        workers: processes that share the environments.

    Attributes:
        played: the episodes of the deterministic actor in the last measurement, if there was one.
    """

    def __init__(
        self,
        config: RunConfig,
        base: ChunkPolicy,
        feasible: tuple[float, float],
        learns: bool,
        variant: str,
        workers: int = 1,
    ):
        self.config, self.base, self.feasible = config, base, feasible
        self.played: Rollout | None = None
        self.extra = config.evaluation.diagnostic_episodes if learns else 0
        self.env = make_env(
            config, base, config.evaluation.episodes + self.extra, variant, True, workers
        )

    def measure(
        self, agent: Any, count: int
    ) -> tuple[dict[str, torch.Tensor], dict[str, float | None]]:
        """Episodes of the deterministic actor on the first ``count`` held-out seeds.

        Returns:
            ManiSkill's metrics, a column of ``count`` values each, and the diagnostics.
        """
        seeds = held_out_seeds(count)
        state = agent.generator.get_state()
        try:
            if not agent.learns:
                self.played = rollout(self.env, lambda obs, rows: agent.act(obs), seeds)
                return self.played.episodes, agent.scalars()
            agent.generator.manual_seed(DIAGNOSTIC_SEED + self.config.seed)
            greedy, on_policy = self._learner_episodes(agent, seeds)
            generator = torch.Generator(agent.device).manual_seed(self.config.seed)
            diagnostics = measure(agent, self.base, greedy, on_policy, self.feasible, generator)
            self.played = greedy
            return greedy.episodes, dict(diagnostics)
        finally:
            # An evaluation draws noise of its own, so that training goes on as if without it.
            agent.generator.set_state(state)

    def close(self) -> None:
        """Free the simulation."""
        self.env.close()

    def _learner_episodes(self, agent: Any, seeds: Sequence[int]) -> tuple[Rollout, OnPolicy]:
        """Deterministic episodes from ``seeds`` and stochastic ones, side by side."""
        greedy_count = len(seeds)
        extra = [DIAGNOSTIC_SEED + i for i in range(self.extra)]
        log_probs: list[torch.Tensor] = []

        def act(obs: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
            noise, log_prob = agent.sample(obs)
            log_probs.append(log_prob)
            deterministic = (rows < greedy_count).to(obs.device)
            return torch.where(
                deterministic[:, None, None], agent.act(obs, deterministic=True), noise
            )

        whole = rollout(self.env, act, [*seeds, *extra])
        # One entry a decision and batch: [batches * T] x [N] -> [T, batches * N].
        steps = len(whole.obs)
        log_prob = torch.cat(
            [torch.stack(log_probs[i : i + steps]) for i in range(0, len(log_probs), steps)], dim=1
        )
        return whole.episodes_of(slice(0, greedy_count)), OnPolicy(
            whole.episodes_of(slice(greedy_count, None)),
            log_prob[:, greedy_count : greedy_count + len(extra)],
        )
