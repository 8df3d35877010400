"""Held-out episodes of an agent, and on-policy episodes to compare its Q-values with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from symsteer.agents.agent import Agent, HasCritic
from symsteer.agents.episodes import Played, Rollout
from symsteer.bench.runs.config import RunConfig
from symsteer.bench.steering.evaluation import rollout
from symsteer.bench.steering.latent_env import LatentNoiseEnv
from symsteer.bench.steering.seeds import DIAGNOSTIC_SEED, diagnostic_seeds, held_out_seeds
from symsteer.bench.tasks import make
from symsteer.policies.contract import ChunkPolicy
from symsteer.variant import VariantSpec


def make_env(
    config: RunConfig,
    base: ChunkPolicy,
    num_envs: int,
    variants: Sequence[VariantSpec],
    ignore_terminations: bool,
    workers: int,
) -> LatentNoiseEnv:
    """The latent-noise environment of a run's task."""
    env = make(
        config.task,
        num_envs=num_envs,
        embodiment=config.embodiment,
        variant=variants,
        sim=config.sim,
        workers=min(workers, num_envs),
    )
    return LatentNoiseEnv(env, base, ignore_terminations, config.seed)


class Evaluator:
    """Plays the held-out episodes and measures the diagnostics; does not change the agent.

    Args:
        config: the run.
        base: the frozen policy.
        agent: the agent that plays.
        feasible: lowest and highest return that the reward allows, per decision.
        variants: of these episodes.
        workers: processes that share the environments.

    Attributes:
        played: the deterministic episodes of the last measurement; None before the first one.
    """

    def __init__(
        self,
        config: RunConfig,
        base: ChunkPolicy,
        agent: Agent,
        feasible: tuple[float, float],
        variants: Sequence[VariantSpec],
        workers: int = 1,
    ):
        self.config, self.agent, self.feasible = config, agent, feasible
        self.played: Rollout | None = None
        wanted = config.evaluation
        self.extra = wanted.diagnostic_episodes if isinstance(agent, HasCritic) else 0
        self.env = make_env(config, base, wanted.episodes + self.extra, variants, True, workers)

    def measure(self, count: int) -> tuple[dict[str, torch.Tensor], Mapping[str, float | None]]:
        """Episodes of the deterministic actor on the first ``count`` held-out seeds.

        Returns:
            ManiSkill's metrics (columns of ``count`` values) and the diagnostics.
        """
        agent, seeds = self.agent, held_out_seeds(count)
        state = agent.generator.get_state()
        try:
            on_policy: Rollout | None = None
            log_prob: torch.Tensor | None = None
            if isinstance(agent, HasCritic):
                agent.generator.manual_seed(DIAGNOSTIC_SEED + self.config.seed)
                greedy, on_policy, log_prob = self._with_on_policy(agent, seeds)
            else:
                greedy = rollout(self.env, lambda obs, rows: agent.act(obs, True), seeds)
            generator = torch.Generator(agent.device).manual_seed(self.config.seed)
            played = Played(greedy, on_policy, log_prob, self.feasible, generator)
            self.played = greedy
            return greedy.episodes, agent.diagnostics(played)
        finally:
            # An evaluation must not change the random numbers of the training after it.
            agent.generator.set_state(state)

    def close(self) -> None:
        """Free the simulation."""
        self.env.close()

    def _with_on_policy(
        self, agent: Agent, seeds: Sequence[int]
    ) -> tuple[Rollout, Rollout, torch.Tensor]:
        """Deterministic episodes from ``seeds``, and stochastic ones in the same batches."""
        assert isinstance(agent, HasCritic)
        greedy_count = len(seeds)
        extra = diagnostic_seeds(self.extra)
        log_probs: list[torch.Tensor] = []

        def act(obs: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
            noise, log_prob = agent.sample(obs)
            log_probs.append(log_prob)
            deterministic = (rows < greedy_count).to(obs.device)
            return torch.where(
                deterministic[:, None, None], agent.act(obs, deterministic=True), noise
            )

        whole = rollout(self.env, act, [*seeds, *extra])
        # One entry per decision and batch: [batches * T] x [N] -> [T, batches * N].
        steps = len(whole.obs)
        log_prob = torch.cat(
            [torch.stack(log_probs[i : i + steps]) for i in range(0, len(log_probs), steps)], dim=1
        )
        on_policy = whole.episodes_of(slice(greedy_count, None))
        return (
            whole.episodes_of(slice(0, greedy_count)),
            on_policy,
            log_prob[:, greedy_count : greedy_count + len(extra)],
        )
