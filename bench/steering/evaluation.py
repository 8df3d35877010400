"""Whole episodes from fixed seeds, episodes with known returns, steerability of a base policy."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import torch

from symsteer.agents.episodes import DECISION_FIELDS, LongEpisodes, Rollout
from symsteer.bench.steering.directions import directions
from symsteer.bench.steering.latent_env import LatentNoiseEnv
from symsteer.bench.steering.seeds import held_out_seeds, steerability_seeds
from symsteer.errors import UserError
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.geometry import Group
from symsteer.policies.steerability import (
    DESIRED_ACTION_STD,
    action_spread,
    decode_error,
    evenly,
    jump,
)

Act = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
"""``(obs [N, obs_dim], rows [N]) -> action [N, rows, Da]``; ``rows`` index the list of seeds."""


def _batches(seeds: Sequence[int], num_envs: int) -> Iterator[tuple[list[int], torch.Tensor, int]]:
    """Seeds in batches of ``num_envs``: the seeds, their rows in the list, and how many count.

    If the last batch is not full, the other environments repeat a seed, stand still and do not
    count.
    """
    for start in range(0, len(seeds), num_envs):
        rows = torch.arange(start, start + num_envs).clamp(max=len(seeds) - 1)
        yield [seeds[int(row)] for row in rows], rows, min(num_envs, len(seeds) - start)


def rollout(env: LatentNoiseEnv, act: Act, seeds: Sequence[int]) -> Rollout:
    """Run one full-length episode from each seed.

    Args:
        env: with ``ignore_terminations``, so that success at the end is measured.
        act: called once per decision for the N parallel environments.
        seeds: any number; they are played in batches of N.

    Raises:
        UserError: if the environment ends episodes at success.
    """
    if not env.ignore_terminations:
        raise UserError("evaluation needs an environment with ignore_terminations=True")
    parts = [_rollout_batch(env, act, *batch) for batch in _batches(seeds, env.num_envs)]
    return Rollout(
        episodes={k: torch.cat([p.episodes[k] for p in parts]) for k in parts[0].episodes},
        **{name: torch.cat([getattr(p, name) for p in parts], dim=1) for name in DECISION_FIELDS},
    )


def _rollout_batch(
    env: LatentNoiseEnv, act: Act, seeds: list[int], rows: torch.Tensor, keep: int
) -> Rollout:
    obs = env.reset(seeds)
    env.pause(torch.arange(env.num_envs) >= keep)
    direction = directions(obs, env.policy.obs_layout)
    steps: dict[str, list[torch.Tensor]] = {name: [] for name in DECISION_FIELDS}
    running = torch.ones(env.num_envs, dtype=torch.bool, device=obs.device)
    for _ in range(math.ceil(env.max_episode_steps / env.execute)):
        action = act(obs, rows)
        result = env.step(action)
        succeeded = running & result.success_once
        row = (obs, action, result.reward, result.next_obs, running, succeeded)
        for name, value in zip(DECISION_FIELDS, row, strict=True):
            steps[name].append(value[:keep])
        running = running & ~succeeded
        obs = result.obs_after
    # All episodes end with the last decision, so the rows are the environments in order.
    episodes = {name: value[:keep] for name, value in result.episodes.items()}
    episodes["seed"] = torch.tensor(seeds[:keep])
    if direction is not None:
        episodes["direction"] = direction[:keep]
    return Rollout(episodes=episodes, **{k: torch.stack(v) for k, v in steps.items()})


def random_noise(policy: ChunkPolicy, seed: int) -> Act:
    """The base policy without an agent: noise from N(0, I)."""
    generator = torch.Generator().manual_seed(seed)

    def act(obs: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        shape = (len(obs), policy.horizon, policy.act_layout.dim)
        return torch.randn(shape, generator=generator).to(obs.device)

    return act


def held_out_episodes(
    env: LatentNoiseEnv, policy: ChunkPolicy, seed: int, episodes: int
) -> Rollout:
    """The first held-out episodes of a base policy with noise from N(0, I).

    Args:
        env: the policy's task.
        policy: the base policy.
        seed: of the noise.
        episodes: how many.
    """
    return rollout(env, random_noise(policy, seed), held_out_seeds(episodes))


Sample = Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]]
"""``obs [N, obs_dim] -> noise [N, Tp, Da], its log-probability [N]``, drawn from the actor."""

Draw = Callable[[int, torch.Generator], torch.Tensor]
"""Actions ``[N, rows, Da]`` of the base policy, drawn by a generator."""

TAIL_WEIGHT = 0.05
"""Largest weight of the unknown future in a return that Q-values are compared with."""

MAX_TAIL = 300
"""Decisions after the last one that counts, at most: what a discount of 0.99 needs."""


def tail_decisions(gamma: float) -> int:
    """Decisions until the future has a weight of at most :data:`TAIL_WEIGHT`.

    Args:
        gamma: discount per decision, in [0, 1).
    """
    return next((k for k in range(1, MAX_TAIL) if gamma**k <= TAIL_WEIGHT), MAX_TAIL)


def long_limit(max_episode_steps: int, execute: int, gamma: float) -> int:
    """The time limit in control steps that :func:`long_episodes` needs.

    Args:
        max_episode_steps: time limit of the task.
        execute: control steps per decision.
        gamma: discount per decision.
    """
    return execute * (math.ceil(max_episode_steps / execute) + tail_decisions(gamma))


def random_beginnings(count: int, decisions: int) -> list[int]:
    """How many decisions of each long episode begin it with noise from N(0, I).

    Every other episode has none. The numbers of the others are spread evenly over the
    ``decisions`` of an episode.
    """
    half = count // 2
    return [1 + (i // 2) * decisions // half if i % 2 else 0 for i in range(count)]


def long_episodes(
    env: LatentNoiseEnv,
    sample: Sample,
    draw: Draw,
    seeds: Sequence[int],
    gamma: float,
    generator: torch.Generator,
) -> LongEpisodes:
    """Play one episode of the stochastic actor from each seed until its return is known.

    All environments of a batch stop together, when the last of them is done; the others stand
    still until then. See
    :class:`~symsteer.agents.episodes.LongEpisodes` for what counts, :func:`random_beginnings` for
    the noise.

    Args:
        env: with ``ignore_terminations``. Its time limit is that of :func:`long_limit`, or the
            task's own, if time-outs end episodes.
        sample: the actor; called once per decision for the N parallel environments.
        draw: the base policy, for the beginnings.
        seeds: any number; they are played in batches of N.
        gamma: discount per decision.
        generator: of the base policy's draws, on the environment's device.
    """
    within = math.ceil(env.env.max_episode_steps / env.execute)
    begin = torch.tensor(random_beginnings(len(seeds), within), device=env.device)
    tail = tail_decisions(gamma)
    parts = []
    for batch, rows, keep in _batches(seeds, env.num_envs):
        begins = begin[rows.to(env.device)]
        part = _long_batch(env, sample, draw, batch, keep, begins, tail, generator)
        parts.append({name: value[:, :keep] for name, value in part.items()})
    longest = max(len(part["reward"]) for part in parts)

    def joined(name: str) -> torch.Tensor:
        padded = [
            torch.cat([x, x.new_zeros(longest - len(x), *x.shape[1:])])
            for x in (part[name] for part in parts)
        ]
        return torch.cat(padded, dim=1)

    return LongEpisodes(
        **{name: joined(name) for name in parts[0]},
        timeouts_end=env.max_episode_steps <= env.env.max_episode_steps,
    )


def _long_batch(
    env: LatentNoiseEnv,
    sample: Sample,
    draw: Draw,
    seeds: list[int],
    keep: int,
    begin: torch.Tensor,
    tail: int,
    generator: torch.Generator,
) -> dict[str, torch.Tensor]:
    """Fields of LongEpisodes of one batch; ``begin [N]`` decisions begin with N(0, I)."""
    obs = env.reset(seeds)
    within = math.ceil(env.env.max_episode_steps / env.execute)
    limit = math.ceil(env.max_episode_steps / env.execute)
    counted_last = torch.where(begin > 0, begin - 1, within - 1)
    # Decisions of each column. Where a time-out ends episodes, returns end with it.
    wanted = counted_last + tail if limit > within else torch.full_like(begin, limit)
    names = ("obs", "noise", "log_prob", "reward", "terminal", "last", "on_policy", "off_policy")
    steps: dict[str, list[torch.Tensor]] = {name: [] for name in names}
    running = torch.arange(env.num_envs, device=env.device) < keep
    for t in range(int(wanted.max())):
        env.pause(~running)
        noise, log_prob = sample(obs)
        random = draw(len(obs), generator)
        noise = torch.where((t < begin)[:, None, None], random, noise)
        result = env.step(noise)
        succeeded = running & result.success_once
        last = running & ~succeeded & (t + 1 == wanted)
        on = running & (begin == 0) & (t < within)
        off = running & (begin == t + 1)
        row = (obs, noise, log_prob, result.reward, succeeded, last, on, off)
        for name, value in zip(names, row, strict=True):
            steps[name].append(value)
        running = running & ~succeeded & ~last
        if not running.any():
            break
        obs = result.obs_after
    return {name: torch.stack(values) for name, values in steps.items()}


VISITED = 256
"""Visited states at which symmetry and jumps are measured."""

DRAWS = 16
"""Noise draws for each initial state of a steerability report."""

MIN_SOLVABLE = 0.9
"""Below this share of solvable initial states steering gained little in pilot runs."""


def steerability(
    env: LatentNoiseEnv, policy: ChunkPolicy, seed: int, states: int, draws: int = DRAWS
) -> dict[str, Any]:
    """How much the noise of a base policy changes its behaviour.

    The noise is drawn ``draws`` times for each of ``states`` initial states. The thresholds of the
    warning come from pilot runs: below them, SAC did not improve the base.

    Returns:
        ``success`` over all ``episodes``; ``states`` and ``draws``; ``solvable``, the share of
        states that at least one draw solves; of visited states ``action_std``
        (:func:`symsteer.policies.steerability.action_spread`), ``equivariance_error`` of decoding
        under C8 (:func:`symsteer.policies.steerability.decode_error`) and ``jump``
        (:func:`symsteer.policies.steerability.jump`); ``warning``, why steering is unlikely to
        work, or None.
    """
    seeds = [start for start in steerability_seeds(seed, states) for _ in range(draws)]
    result = rollout(env, random_noise(policy, seed), seeds)
    success = result.episodes["success_once"].float().view(states, draws)
    # The states that the first draw of every initial state visits before its first success.
    visited = result.obs[:, ::draws][result.running[:, ::draws]]
    action_std = action_spread(policy, visited, draws, seed)
    some = evenly(visited, VISITED)
    solvable = (success.amax(dim=1) > 0).float().mean().item()
    reasons = []
    if solvable < MIN_SOLVABLE:
        reasons.append(f"only {solvable:.0%} of the initial states are ever solved")
    if action_std < DESIRED_ACTION_STD:
        reasons.append(f"the noise moves the actions by only {action_std:.2f}")
    return {
        "success": success.mean().item(),
        "episodes": states * draws,
        "solvable": solvable,
        "states": states,
        "draws": draws,
        "action_std": action_std,
        "equivariance_error": decode_error(policy, some, Group.parse("C8"), seed),
        "jump": jump(policy, some, seed),
        "warning": f"little to steer: {' and '.join(reasons)}" if reasons else None,
    }
