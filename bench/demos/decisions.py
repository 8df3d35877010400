"""Demonstrations as decisions of the latent-noise environment, for critics of actions."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from symsteer.agents.replay import Transition
from symsteer.bench.demos.load import Demonstrations
from symsteer.policies.training.demonstrations import make_chunks


def decisions(
    demos: Demonstrations, execute: int, horizon: int, hold: Sequence[str] = ()
) -> Transition:
    """One decision for every control step of the demonstrations, in order of time.

    An episode ends with its first success, so a step costs 1 except for the last one. The noise
    that would be decoded to the actions is not known; it is 0.

    Args:
        demos: successful episodes.
        execute: Ta, actions per decision.
        horizon: Tp, actions in a chunk of noise.
        hold: action fields that keep their last value behind the end of an episode.
    """
    obs, actions = make_chunks(demos.episodes, demos.action_layout, execute, hold)
    following, left = [], []
    for seen, taken in demos.episodes:
        steps = torch.arange(len(taken))
        following.append(seen.float()[(steps + execute).clamp(max=len(taken))])
        left.append(len(taken) - steps)
    remaining = torch.cat(left)
    terminal = remaining <= execute
    return Transition(
        obs=obs,
        noise=torch.zeros(len(obs), horizon, demos.action_layout.dim),
        actions=actions,
        reward=-torch.where(terminal, remaining - 1, execute).float(),
        next_obs=torch.cat(following),
        terminal=terminal,
        truncated=torch.zeros_like(terminal),
    )
