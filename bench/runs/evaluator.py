"""Held-out episodes of an agent, and longer ones to compare its Q-values with."""

from __future__ import annotations

import contextlib
import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import torch

from symsteer.agents import AGENTS
from symsteer.agents.agent import Agent, AgentContext, Deterministic, HasCritic
from symsteer.agents.episodes import LongEpisodes, Played, Rollout
from symsteer.bench.runs.config import RunConfig
from symsteer.bench.sim.environment import MAX_SCENES
from symsteer.bench.steering.evaluation import Act, long_episodes, long_limit, rollout
from symsteer.bench.steering.latent_env import LatentNoiseEnv
from symsteer.bench.steering.seeds import DIAGNOSTIC_SEED, diagnostic_seeds, held_out_seeds
from symsteer.bench.tasks import make, task_class
from symsteer.bench.variants import build, highest_cost
from symsteer.errors import UserError
from symsteer.policies.contract import ChunkPolicy
from symsteer.variant import VariantSpec, specs_at

LONG_ENVS = 32
"""Parallel environments of long episodes, at most."""


def check_room(
    configs: Sequence[RunConfig], workers: int = 1, trains: bool = True, cure: str = ""
) -> None:
    """Refuse runs that need more scenes than their processes can hold (`UserError`).

    Args:
        configs: of the runs that share a process.
        workers: processes that share the environments of a run.
        trains: whether there are training environments.
        cure: what to do instead; default: the options of `symsteer run`.
    """
    held, most = 0, 1
    for config in configs:
        wanted, agent = config.evaluation, AGENTS.get(config.agent)
        # The plain base policy has no training environments.
        training = config.num_envs if trains and agent.prepare is not Agent.prepare else 0
        counts = wanted.diagnostic_episodes, wanted.final_diagnostic_episodes
        limit = LONG_ENVS if issubclass(agent, HasCritic) else 0
        long, final = (min(count, limit) for count in counts)
        # The final evaluation begins after the training environments are closed.
        held += wanted.episodes + max(training + long, final)
        most = max(most, training, wanted.episodes, final)
    # A process has all environments, or a share of one kind. Fresh scenes are made before the
    # former ones are freed.
    needed = held + most if workers == 1 else 2 * math.ceil(most / min(workers, most))
    if needed > MAX_SCENES and configs[0].sim == "cpu":
        processes = max(2, math.ceil(most / (MAX_SCENES // 2)))
        divide = f"use --sim-workers {processes}, or " if processes <= configs[0].num_envs else ""
        cure = cure or f"{divide}make fewer (--num-envs, --evaluation.episodes)"
        raise UserError(
            f"one process holds at most {MAX_SCENES} PhysX scenes, but {needed} are needed while "
            f"those of {most} environments are replaced; {cure}"
        )


def new_agent(config: RunConfig, policy: ChunkPolicy) -> Agent:
    """An untrained agent for a run's base policy."""
    context = AgentContext.of(policy, config.device, config.seed)
    return AGENTS.get(config.agent)(context, config.agent_options)


@dataclass(eq=False)
class Steered:
    """A frozen base policy and the agent that steers it, in the worlds of a run."""

    config: RunConfig
    policy: ChunkPolicy
    agent: Agent

    @property
    def gamma(self) -> float:
        """The discount per decision of the agent's Q-values; 0 for an agent without one."""
        return getattr(self.agent.options, "gamma", 0.0)

    @property
    def timeouts_end(self) -> bool:
        """Whether Q-values count nothing after a time-out, rather than bootstrap."""
        return getattr(self.agent.options, "timeouts_terminal", False)

    @functools.cached_property
    def feasible(self) -> tuple[float, float]:
        """Lowest and highest discounted return that the run's reward allows, per decision."""
        return task_class(self.config.task).feasible_return(
            self.gamma,
            self.policy.execute,
            bootstrap_truncation=not self.timeouts_end,
            step_cost=highest_cost(build(specs_at(self.config.variants, 1))),
        )

    def make_env(
        self,
        variants: Sequence[VariantSpec],
        num_envs: int,
        ignore_terminations: bool,
        workers: int,
    ) -> LatentNoiseEnv:
        """The latent-noise environment of the run's task."""
        config = self.config
        env = make(
            config.task,
            num_envs=num_envs,
            embodiment=config.embodiment,
            variant=variants,
            sim=config.sim,
            workers=min(workers, num_envs),
        )
        decode = self.agent.decode
        return LatentNoiseEnv(env, self.policy, ignore_terminations, config.seed, decode=decode)


class Evaluator:
    """Plays the held-out episodes and measures the diagnostics; does not change the agent.

    Args:
        steered: who plays.
        variants: of the first episodes.
        workers: processes that share the environments.

    Attributes:
        variants: of the episodes now.
        played: the deterministic episodes of the last :meth:`play`; None before the first one.
    """

    def __init__(self, steered: Steered, variants: Sequence[VariantSpec], workers: int = 1):
        self.steered, self.variants, self.workers = steered, tuple(variants), workers
        self.played: Rollout | None = None
        self.env = self._env(steered.config.evaluation.episodes)
        self.long_env: LatentNoiseEnv | None = None

    def enter(self, variants: Sequence[VariantSpec]) -> None:
        """Play further episodes with these variants."""
        if self.variants != tuple(variants):
            self.close()
            self.variants = tuple(variants)
            self.env, self.long_env = self._env(self.steered.config.evaluation.episodes), None

    def _env(self, num_envs: int) -> LatentNoiseEnv:
        return self.steered.make_env(self.variants, num_envs, True, self.workers)

    def play(self, count: int) -> Rollout:
        """Episodes of the deterministic actor on the first ``count`` held-out seeds."""
        with self._unchanged_agent() as agent:
            seeds = held_out_seeds(count)
            self.played = rollout(self.env, lambda obs, _: agent.act(obs, True), seeds)
        return self.played

    def diagnose(self, count: int) -> Mapping[str, float | None]:
        """Diagnostics of the agent on the episodes of the last :meth:`play`.

        Args:
            count: episodes of the stochastic actor, with whose returns Q-values are compared.
        """
        assert self.played is not None
        seed = self.steered.config.seed
        with self._unchanged_agent() as agent:
            long: LongEpisodes | None = None
            if isinstance(agent, HasCritic):
                agent.generator.manual_seed(DIAGNOSTIC_SEED + seed)
                long = long_episodes(
                    self._long_env(min(count, LONG_ENVS)),
                    agent.sample,
                    agent.gaussian_noise,
                    diagnostic_seeds(count),
                    self.steered.gamma,
                    torch.Generator(agent.device).manual_seed(DIAGNOSTIC_SEED + seed + 1),
                )
            generator = torch.Generator(agent.device).manual_seed(seed)
            return agent.diagnostics(Played(self.played, long, self.steered.feasible, generator))

    def compare(self) -> dict[str, float]:
        """Shares of successes of the agent's other ways to act, on the first held-out seeds."""
        wanted, shares = self.steered.config.evaluation, {}
        with self._unchanged_agent() as agent:
            for name, way in agent.alternatives().items():
                played = self._episodes(_every_row(way), wanted.final_episodes)
                shares[f"success_{name}"] = _share(played, "success_once")
            if wanted.stochastic_episodes and isinstance(agent, HasCritic):
                agent.generator.manual_seed(DIAGNOSTIC_SEED + self.steered.config.seed + 2)
                played = self._episodes(
                    lambda obs, _: agent.sample(obs)[0], wanted.stochastic_episodes
                )
                shares["success_stochastic"] = _share(played, "success_once")
                shares["success_at_end_stochastic"] = _share(played, "success_at_end")
        return shares

    def _episodes(self, act: Act, count: int) -> Mapping[str, torch.Tensor]:
        return rollout(self.env, act, held_out_seeds(count)).episodes

    def close(self) -> None:
        """Free the simulation."""
        self.env.close()
        if self.long_env is not None:
            self.long_env.close()

    def _long_env(self, num_envs: int) -> LatentNoiseEnv:
        """Environments whose episodes go on until their returns are known."""
        if self.long_env is None or self.long_env.num_envs != num_envs:
            if self.long_env is not None:
                self.long_env.close()
            self.long_env = env = self._env(num_envs)
            if not self.steered.timeouts_end:
                limit, gamma = env.max_episode_steps, self.steered.gamma
                env.max_episode_steps = long_limit(limit, env.execute, gamma)
        return self.long_env

    @contextlib.contextmanager
    def _unchanged_agent(self) -> Iterator[Agent]:
        """The agent; its random numbers continue afterwards as if nothing had happened."""
        agent = self.steered.agent
        state = agent.generator.get_state()
        try:
            yield agent
        finally:
            agent.generator.set_state(state)


def _every_row(act: Deterministic) -> Act:
    return lambda obs, rows: act(obs)


def _share(episodes: Mapping[str, torch.Tensor], success: str) -> float:
    return episodes[success].double().mean().item()
