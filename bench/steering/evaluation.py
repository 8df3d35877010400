"""Whole episodes from a fixed list of seeds, and the steerability of a base policy."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch

from symsteer.agents.episodes import DECISION_FIELDS, Rollout
from symsteer.bench.steering.latent_env import LatentNoiseEnv
from symsteer.bench.steering.seeds import steerability_seeds
from symsteer.errors import UserError
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.steerability import DESIRED_ACTION_STD, action_spread

Act = Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
"""``(obs [N, obs_dim], rows [N]) -> noise [N, Tp, Da]``; ``rows`` index the list of seeds."""


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
    parts = []
    for start in range(0, len(seeds), env.num_envs):
        # If the last batch is not full, the other environments repeat a seed and are dropped.
        rows = torch.arange(start, start + env.num_envs).clamp(max=len(seeds) - 1)
        keep = min(env.num_envs, len(seeds) - start)
        parts.append(_rollout_batch(env, act, [seeds[int(row)] for row in rows], rows, keep))
    return Rollout(
        episodes={k: torch.cat([p.episodes[k] for p in parts]) for k in parts[0].episodes},
        **{name: torch.cat([getattr(p, name) for p in parts], dim=1) for name in DECISION_FIELDS},
    )


def _rollout_batch(
    env: LatentNoiseEnv, act: Act, seeds: list[int], rows: torch.Tensor, keep: int
) -> Rollout:
    obs = env.reset(seeds)
    decisions = math.ceil(env.max_episode_steps / env.execute)
    steps: dict[str, list[torch.Tensor]] = {name: [] for name in DECISION_FIELDS}
    running = torch.ones(env.num_envs, dtype=torch.bool, device=obs.device)
    for _ in range(decisions):
        noise = act(obs, rows)
        result = env.step(noise)
        succeeded = running & result.success_once
        row = (obs, noise, result.reward, result.next_obs, running, succeeded)
        for name, value in zip(DECISION_FIELDS, row, strict=True):
            steps[name].append(value[:keep])
        running = running & ~succeeded
        obs = result.obs_after
    # All episodes end with the last decision, so the rows are the environments in order.
    episodes = {name: value[:keep] for name, value in result.episodes.items()}
    episodes["seed"] = torch.tensor(seeds[:keep])
    return Rollout(episodes=episodes, **{k: torch.stack(v) for k, v in steps.items()})


@dataclass
class Steerability:
    """How much the noise of a base policy changes its behaviour.

    Attributes:
        success: share of successful episodes over all states and draws (noise from N(0, I)).
        episodes: number of episodes.
        solvable: share of initial states that at least one of the draws solves.
        states: number of initial states.
        draws: noise draws per state.
        action_std: spread of the normalised actions over the noise on visited states; see
            :func:`symsteer.policies.steerability.action_spread`.
        warning: why steering is unlikely to work, or None.
    """

    success: float
    episodes: int
    solvable: float
    states: int
    draws: int
    action_std: float
    warning: str | None


DRAWS = 16
"""Noise draws for each initial state of a steerability report."""

MIN_SOLVABLE = 0.9
"""Below this share of solvable initial states steering gained little in pilot runs."""


def steerability(
    env: LatentNoiseEnv, policy: ChunkPolicy, seed: int, states: int, draws: int = DRAWS
) -> Steerability:
    """Draw noise ``draws`` times for each of ``states`` initial states.

    The thresholds of the warning come from pilot runs: below them, SAC did not improve the base.
    """
    generator = torch.Generator().manual_seed(seed)
    seeds = [start for start in steerability_seeds(seed, states) for _ in range(draws)]

    def act(obs: torch.Tensor, rows: torch.Tensor) -> torch.Tensor:
        shape = (len(obs), policy.horizon, policy.act_layout.dim)
        return torch.randn(shape, generator=generator).to(obs.device)

    result = rollout(env, act, seeds)
    success = result.episodes["success_once"].float().view(states, draws)
    # The states that the first draw of every initial state visits before its first success.
    visited = result.obs[:, ::draws][result.running[:, ::draws]]
    action_std = action_spread(policy, visited, draws, seed)["action_std"]
    solvable = (success.amax(dim=1) > 0).float().mean().item()
    reasons = []
    if solvable < MIN_SOLVABLE:
        reasons.append(f"only {solvable:.0%} of the initial states are ever solved")
    if action_std < DESIRED_ACTION_STD:
        reasons.append(f"the noise moves the actions by only {action_std:.2f}")
    return Steerability(
        success=success.mean().item(),
        episodes=states * draws,
        solvable=solvable,
        states=states,
        draws=draws,
        action_std=action_std,
        warning=f"little to steer: {' and '.join(reasons)}" if reasons else None,
    )
