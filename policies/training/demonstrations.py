"""Demonstrations as training data: pairs of an observation and the chunk that follows it."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from symsteer.errors import UserError
from symsteer.policies.contract import Episode
from symsteer.policies.geometry import Layout


def make_chunks(
    episodes: Sequence[Episode], act_layout: Layout, horizon: int, hold: Sequence[str] = ()
) -> tuple[torch.Tensor, torch.Tensor]:
    """Cut episodes into (observation, action chunk) pairs, one for every step.

    A chunk that runs past the end of its episode is filled with actions that do nothing: zero,
    except for the fields in ``hold``, which keep their last value (a gripper's absolute target).
    Names in ``hold`` that the layout lacks are ignored.

    Args:
        episodes: pairs of ``obs [T + 1, obs_dim]`` (or ``[T, obs_dim]``) and
            ``actions [T, act_dim]``.

    Returns:
        ``obs [M, obs_dim]`` and ``chunks [M, horizon, act_dim]``, float32.
    """
    held = torch.zeros(act_layout.dim)
    for field in act_layout.fields:
        if field.name in hold:
            held[act_layout.slice(field.name)] = 1.0
    observations, chunks = [], []
    for obs, actions in episodes:
        obs, actions = obs.float(), actions.float()
        padding = (actions[-1] * held).expand(horizon - 1, -1)
        padded = torch.cat([actions, padding])
        observations.append(obs[: len(actions)])
        chunks.append(padded.unfold(0, horizon, 1).transpose(1, 2))
    return torch.cat(observations), torch.cat(chunks)


def check_episodes(episodes: Sequence[Episode], obs_layout: Layout, act_layout: Layout) -> None:
    """Check that there are episodes and that their shapes fit the layouts.

    Raises:
        UserError: naming the first one that does not fit.
    """
    if not episodes:
        raise UserError("no demonstrations to train on; record some first")
    for number, (obs, actions) in enumerate(episodes):
        if (
            obs.dim() != 2
            or actions.dim() != 2
            or obs.shape[1] != obs_layout.dim
            or actions.shape[1] != act_layout.dim
            or not 1 <= len(actions) <= len(obs)
        ):
            raise UserError(
                f"demonstration {number} has observations {tuple(obs.shape)} and actions "
                f"{tuple(actions.shape)}; needed are [T + 1, {obs_layout.dim}] and "
                f"[T, {act_layout.dim}] with T >= 1"
            )
