"""Whole episodes as tensors. Evaluations play them, diagnostics are computed from them."""

from __future__ import annotations

from dataclasses import dataclass

import torch

DECISION_FIELDS = ("obs", "noise", "reward", "next_obs", "running", "terminal")


@dataclass
class Rollout:
    """Full-length episodes: N episodes of T decisions each.

    Attributes:
        episodes: columns ``seed, success_once, success_at_end, return, episode_len`` of
            ManiSkill's metrics, each ``[N]``.
        obs: observation of every decision, ``[T, N, obs_dim]``.
        noise: chosen by the agent, ``[T, N, Tp, Da]``.
        reward: summed over the executed steps, ``[T, N]``.
        next_obs: ``[T, N, obs_dim]``.
        running: no success before this decision, ``[T, N]`` bool.
        terminal: the first success happened in this decision, ``[T, N]`` bool.
    """

    episodes: dict[str, torch.Tensor]
    obs: torch.Tensor
    noise: torch.Tensor
    reward: torch.Tensor
    next_obs: torch.Tensor
    running: torch.Tensor
    terminal: torch.Tensor

    def episodes_of(self, rows: slice) -> Rollout:
        """The same data for some of the episodes."""
        return Rollout(
            episodes={name: value[rows] for name, value in self.episodes.items()},
            **{name: getattr(self, name)[:, rows] for name in DECISION_FIELDS},
        )


@dataclass
class Played:
    """The episodes of one evaluation.

    Attributes:
        greedy: of the deterministic actor.
        on_policy: of the stochastic actor; None for agents without a critic.
        log_prob: of the noise in ``on_policy``, ``[T, N]``; None if ``on_policy`` is None.
        feasible: lowest and highest discounted return that the reward allows, per decision.
        generator: for random noise that diagnostics need, on the agent's device.
    """

    greedy: Rollout
    on_policy: Rollout | None
    log_prob: torch.Tensor | None
    feasible: tuple[float, float]
    generator: torch.Generator
