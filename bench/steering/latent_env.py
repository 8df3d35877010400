"""The MDP that a steering agent sees: its action is the noise that the base policy decodes.

State s, action w in R^(Tp x Da). The frozen policy decodes the chunk a = pi_dp(s, w). The first Ta
actions of it are executed, and their rewards are summed (DSRL, arXiv 2506.15799; Equi-DSRL, arXiv
2512.11345). An agent whose action is something else, such as a correction of a chunk, says with
its own ``decode`` what the action does.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import torch

from symsteer.agents.agent import Decode
from symsteer.agents.replay import Transition
from symsteer.bench.steering.seeds import training_seeds
from symsteer.policies.contract import ChunkPolicy


@dataclass
class Step(Transition):
    """The result of one decision; every tensor has N rows.

    ``reward`` is -1 for every executed step before success, minus the extra cost of a variant
    (``info["extra_cost"]``), summed over the chunk.

    Attributes:
        obs_after: observation for the next decision, ``[N, obs_dim]``. If the episode ended, it is
            the first one of the new episode.
        success_once: success in this episode so far, ``[N]`` bool.
        episodes: ManiSkill's metrics of the episodes that ended, each ``[number ended]``.
    """

    obs_after: torch.Tensor
    success_once: torch.Tensor
    episodes: dict[str, torch.Tensor]


@dataclass
class Clock:
    """Seconds that a run has spent on its parts."""

    simulate: float = 0.0
    decode: float = 0.0
    update: float = 0.0
    evaluate: float = 0.0
    diagnose: float = 0.0


@dataclass
class LatentNoiseEnv:
    """N parallel environments in which one action of an agent is a chunk of actions of the task.

    Args:
        env: parallel ManiSkill environments from :func:`symsteer.bench.tasks.make`.
        policy: frozen decoder with the same layouts; observations are what it makes of the
            task's (:meth:`~symsteer.policies.contract.ChunkPolicy.see`). All inputs and outputs are
            on its device, also if physics runs on another one.
        decode: ``(obs, action) -> chunk [N, Tp, Da]`` of an agent; default: the action is noise,
            and the policy decodes it.
        ignore_terminations: episodes go on to the time limit after a success, as in ManiSkill's
            evaluation. If False, a success ends the episode.
        seed: of the run, for :meth:`training_seeds`.
        max_episode_steps: time limit of an episode; 0 for the task's own.

    Attributes:
        control_steps: executed so far, summed over the environments.
        decisions: taken so far, summed over the environments.
    """

    env: Any
    policy: ChunkPolicy
    ignore_terminations: bool = False
    seed: int = 0
    max_episode_steps: int = 0
    decode: Decode | None = None
    clock: Clock = field(default_factory=Clock)

    def __post_init__(self) -> None:
        self.num_envs: int = self.env.num_envs
        self.execute = self.policy.execute
        self.max_episode_steps = self.max_episode_steps or self.env.max_episode_steps
        self.device = self.policy.device
        self.control_steps = 0
        self.decisions = 0

    def training_seeds(self, start: int, count: int) -> list[int]:
        """Seeds of ``count`` training episodes, for the ``start``-th fresh start of the run."""
        return training_seeds(self.seed, start, count)

    def reset(self, seeds: list[int]) -> torch.Tensor:
        """Start new episodes, environment i from ``seeds[i]``; observations ``[N, obs_dim]``."""
        start = time.perf_counter()
        # In PhysX the order of contacts depends on the history of a scene. Only in fresh scenes
        # are episodes independent of those before.
        obs, _ = self.env.reset(seed=seeds, options={"reconfigure": True})
        self._obs = self.policy.see(obs.to(self.device))
        self._elapsed = torch.zeros(self.num_envs, dtype=torch.int64, device=self.device)
        self._return = torch.zeros(self.num_envs, device=self.device)
        self._success_once = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        self.clock.simulate += time.perf_counter() - start
        return self._obs

    @torch.no_grad()
    def step(self, action: torch.Tensor) -> Step:
        """Decode ``action [N, rows, Da]``, execute Ta steps of the chunk, reset ended episodes.

        Steps of a chunk after the end of its episode are not counted. The transition holds the
        action in its field ``noise``.
        """
        start = time.perf_counter()
        obs = self._obs
        chunk = (self.decode or self.policy.decode)(obs, action)
        actions = chunk.to(self.env.device)
        decoded = time.perf_counter()
        # If all episodes reach their time limit within the chunk, its rest is not needed.
        steps = min(self.execute, self.max_episode_steps - int(self._elapsed.min()))
        after = self._elapsed[:, None] + torch.arange(1, steps + 1, device=self.device)
        due = after == self.max_episode_steps
        seen, info = self.env.step_chunk(
            actions[:, :steps], due.to(self.env.device), not self.ignore_terminations
        )
        success = info["success"].to(self.device)
        ends = due if self.ignore_terminations else due | success
        # What follows the first end does not count.
        counts = ends.cumsum(dim=1) - ends.long() == 0
        rows, last = torch.arange(self.num_envs, device=self.device), counts.sum(dim=1) - 1
        succeeded = self._success_once[:, None] | ((success & counts).cumsum(dim=1) > 0)
        costs = (counts & ~succeeded).float()
        if "extra_cost" in info:
            costs = costs * (1 + info["extra_cost"].to(self.device))
        reward = torch.zeros(self.num_envs, device=self.device)
        for cost in costs.unbind(dim=1):
            reward -= cost
        over, success = ends[rows, last], success[rows, last]
        terminal = over & success & (not self.ignore_terminations)
        truncated = over & ~terminal
        next_obs = self.policy.see(seen.to(self.device)[rows, last])
        self._elapsed += last + 1
        self._success_once = success_once = succeeded[:, -1]
        self.control_steps += self.num_envs * (int(last.max()) + 1)
        self.decisions += self.num_envs
        self._return += reward
        ended = over.nonzero().flatten()
        episodes = {
            "success_once": success_once[ended],
            "success_at_end": success[ended],
            "return": self._return[ended],
            "episode_len": self._elapsed[ended],
        }
        self._obs = next_obs
        if len(ended):
            fresh, _ = self.env.reset(options={"env_idx": ended.to(self.env.device)})
            self._obs = next_obs.clone()
            self._obs[ended] = self.policy.see(fresh.to(self.device)[ended])
            self._elapsed[ended] = 0
            self._return[ended] = 0
            self._success_once = success_once & ~over
        self.clock.decode += decoded - start
        self.clock.simulate += time.perf_counter() - decoded
        return Step(
            obs=obs,
            noise=action,
            actions=chunk[:, : self.execute],
            reward=reward,
            next_obs=next_obs,
            terminal=terminal,
            truncated=truncated,
            obs_after=self._obs,
            success_once=success_once,
            episodes=episodes,
        )

    def pause(self, rows: torch.Tensor) -> None:
        """Let environments ``[N]`` bool, whose results do not matter, stand still until a reset."""
        self.env.unwrapped.pause(rows.cpu())

    def close(self) -> None:
        """Free the simulation."""
        self.env.close()
