"""Whole episodes as tensors. Evaluations play them, diagnostics are computed from them."""

from __future__ import annotations

from dataclasses import dataclass

import torch

DECISION_FIELDS = ("obs", "noise", "reward", "next_obs", "running", "terminal")


@dataclass
class Rollout:
    """Full-length episodes: N episodes of T decisions each.

    Attributes:
        episodes: columns ``seed, success_once, success_at_end, return, episode_len, direction`` of
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


@dataclass
class LongEpisodes:
    """Episodes of the stochastic actor that go on until their returns are known, ``[T, N, ...]``.

    A column ends with the first success, or where the future has little weight in the return of
    the last decision that counts; what follows in it means nothing.

    Attributes:
        obs: observation of every decision, ``[T, N, obs_dim]``.
        noise: of every decision, ``[T, N, Tp, Da]``.
        log_prob: of the actor's own draw in that state, ``[T, N]``.
        reward: summed over the executed steps, ``[T, N]``.
        terminal: the first success happened in this decision, ``[T, N]`` bool.
        last: the column's last decision, where that is no success, ``[T, N]`` bool.
        on_policy: drawn from the actor in a state that it reached by itself, before the first
            success and within the time limit of an episode, ``[T, N]`` bool.
        off_policy: drawn from N(0, I), as all decisions before it, and followed by the actor,
            ``[T, N]`` bool.
        timeouts_end: nothing follows the last decision, because time-outs end episodes.
    """

    obs: torch.Tensor
    noise: torch.Tensor
    log_prob: torch.Tensor
    reward: torch.Tensor
    terminal: torch.Tensor
    last: torch.Tensor
    on_policy: torch.Tensor
    off_policy: torch.Tensor
    timeouts_end: bool


@dataclass
class Played:
    """The episodes of one evaluation.

    Attributes:
        greedy: of the deterministic actor.
        long: of the stochastic actor, to compare Q-values with; None for agents without a critic.
        feasible: lowest and highest discounted return that the reward allows, per decision.
        generator: for random noise that diagnostics need, on the agent's device.
    """

    greedy: Rollout
    long: LongEpisodes | None
    feasible: tuple[float, float]
    generator: torch.Generator
