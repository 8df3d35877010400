"""How much a base policy's actions depend on its noise.

Steering chooses the noise. If every noise decodes to the same actions, there is nothing to steer.
This part of the steerability report needs no simulator; success over noise draws is measured in
:mod:`symsteer.bench.steering.evaluation`.
"""

from __future__ import annotations

import math

import torch

from symsteer.errors import UserError
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.geometry import Group, equivariance_error

DESIRED_ACTION_STD = 0.3
"""Below this spread of normalised actions steering gained little in pilot runs."""

STILL = 1e-2
"""Action blocks that vary less in the demonstrations are left out of the mean."""

NUDGE = 1e-3
"""Length of the change of an observation in :func:`jump`: a millimetre, if it moves a position."""

NUDGES = 16


def evenly(rows: torch.Tensor, count: int) -> torch.Tensor:
    """At most ``count`` of the rows, at even distances."""
    return rows[torch.linspace(0, len(rows) - 1, min(count, len(rows))).long()]


@torch.no_grad()
def decode_error(
    policy: ChunkPolicy, observations: torch.Tensor, group: Group, seed: int = 0
) -> float:
    """Equivariance error of decoding N(0, I) noise.

    Args:
        policy: the base policy.
        observations: ``[N, obs_dim]``, environment units.
        group: its elements turn observations, noise and chunks.
        seed: of the noise.
    """
    shape = (len(observations), policy.horizon, policy.act_layout.dim)
    noise = torch.randn(shape, generator=torch.Generator().manual_seed(seed)).to(observations)
    layouts, chunk = (policy.obs_layout, policy.act_layout), policy.act_layout
    return equivariance_error(policy.decode, (observations, noise), layouts, chunk, group)


@torch.no_grad()
def jump(policy: ChunkPolicy, observations: torch.Tensor, seed: int = 0) -> float:
    """How much the executed actions change when the observation hardly does, at fixed noise.

    Each observation is changed ``NUDGES`` times by a random vector of length ``NUDGE``. The change
    of the executed actions is the largest over steps of its norm, in units of the bound of an
    action's block. A policy that is continuous changes a little everywhere; one whose frame jumps
    changes a lot in few places.

    Args:
        policy: the base policy.
        observations: ``[N, obs_dim]``, environment units.
        seed: of noise and changes.

    Returns:
        The 99.9 % quantile of the changes.
    """
    count, layout = len(observations), policy.act_layout
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(count, policy.horizon, layout.dim, generator=generator).to(observations)
    own = policy.decode(observations, noise)[:, : policy.execute]
    largest = []
    for _ in range(NUDGES):
        change = torch.randn(observations.shape, generator=generator).to(observations)
        change *= NUDGE / change.norm(dim=1, keepdim=True)
        moved = policy.decode(observations + change, noise)[:, : policy.execute]
        largest.append((moved - own).norm(dim=-1).amax(dim=1))
    return torch.cat(largest).double().quantile(0.999).item()


@torch.no_grad()
def action_spread(
    policy: ChunkPolicy, observations: torch.Tensor, draws: int = 16, seed: int = 0
) -> float:
    """Standard deviation of the executed actions over the noise, relative to the demonstrations'.

    For each irrep block: the root mean square, over observations, executed steps and components,
    of the standard deviation over ``draws`` standard normal noises, divided by the block's
    standard deviation over all demonstrated actions. The result is the mean over the blocks that
    move in the demonstrations. 0: the actions depend on the observations only. 1: at a fixed
    observation they vary as much as all demonstrated actions. Invariant under rotations.

    Args:
        policy: the base policy.
        observations: ``[N, obs_dim]``, environment units; states that the policy visits.
        draws: noises per observation, at least 2.
        seed: of the noises.

    Raises:
        UserError: if there are no observations or fewer than 2 draws.
    """
    if draws < 2 or len(observations) == 0:
        raise UserError(
            f"the spread over the noise needs at least 1 observation and 2 draws, not "
            f"{len(observations)} and {draws}"
        )
    count, layout = len(observations), policy.act_layout
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(draws, count, policy.horizon, layout.dim, generator=generator)
    actions = torch.stack([policy.decode(observations, w.to(observations)) for w in noise])
    variance = actions[:, :, : policy.execute].var(dim=0).mean(dim=(0, 1))
    deviation = policy.act_normalizer.deviation
    ratios = [
        math.sqrt(float(variance[block].mean())) / float(deviation[block][0])
        for block in layout.blocks
        if deviation[block][0] >= STILL
    ]
    return sum(ratios) / len(ratios) if ratios else 0.0
