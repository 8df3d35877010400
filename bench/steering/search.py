"""The golden ticket: the best constant noise, found by search on training episodes.

One noise chunk for all states, as in arXiv 2603.15757; the search is sequential halving (Karnin,
Koren and Somekh, ICML 2013): every round plays the candidates that are left on the same initial
states and keeps the better half.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

from symsteer.bench.steering.evaluation import Act, rollout
from symsteer.bench.steering.latent_env import LatentNoiseEnv
from symsteer.errors import UserError

MAX_CANDIDATES = 64


@dataclass
class Found:
    """The ticket and how it did in the last round of the search.

    Attributes:
        ticket: noise ``[Tp, Da]``.
        success: share of its episodes in the last round that succeeded.
        episodes: how many these are.
        candidates: how many the search began with.
    """

    ticket: torch.Tensor
    success: float
    episodes: int
    candidates: int


def search_ticket(
    env: LatentNoiseEnv,
    draw: Callable[[int], torch.Tensor],
    budget: int,
    seeds: Callable[[int, int], list[int]],
) -> Found:
    """Search the best of up to 64 constant noises by mean return.

    Args:
        env: training environments with ``ignore_terminations``.
        draw: ``draw(count) -> [count, Tp, Da]``, the candidates. Of equally good ones the first
            is kept.
        budget: control steps that the search may use, summed over the environments.
        seeds: ``seeds(round, count)``, the initial states of a round.

    Raises:
        UserError: if the budget does not suffice for two candidates.
    """
    sizes = rounds(env.num_envs, env.max_episode_steps, budget)
    left = draw(sizes[0])
    batch = env.num_envs * env.max_episode_steps
    for number, size in enumerate(sizes):
        batches = max(-(-size // env.num_envs), budget // len(sizes) // batch)
        starts = max(1, batches * env.num_envs // size)
        noise = left.repeat(starts, 1, 1)
        seeds_of_rows = [seed for seed in seeds(number, starts) for _ in range(size)]
        played = rollout(env, _constant(noise), seeds_of_rows).episodes
        score = played["return"].double().view(starts, size).mean(0)
        order = score.argsort(descending=True, stable=True)
        best = order[: max(1, size // 2)].sort().values
        success = played["success_once"].double().view(starts, size).mean(0)[order[0]].item()
        if len(best) > 1:
            left = left[best]
    return Found(left[order[0]], success, starts, sizes[0])


def _constant(noise: torch.Tensor) -> Act:
    """Noise ``[rows, Tp, Da]``, each row's for its whole episode."""
    return lambda obs, rows: noise[rows]


def rounds(num_envs: int, max_episode_steps: int, budget: int) -> list[int]:
    """Candidates of every round: as many as the budget can play once in each round.

    Raises:
        UserError: if the budget does not suffice for two candidates.
    """
    batch = num_envs * max_episode_steps
    candidates = MAX_CANDIDATES
    while candidates >= 2:
        sizes = [candidates >> i for i in range(int(math.log2(candidates)))]
        share = budget // len(sizes) // batch
        if all(share >= -(-size // num_envs) for size in sizes):
            return sizes
        candidates //= 2
    raise UserError(
        f"env_steps is {budget}; a search of the best constant noise needs at least {batch}, one "
        f"episode of {max_episode_steps} steps in each of {num_envs} environments: "
        "raise env_steps or lower num_envs"
    )
