"""How much of a base policy's behavior its noise decides.

Steering chooses the noise; where every noise decodes to the same actions there is nothing to
steer. This is the part of the steerability report that needs no simulator; success over noise
draws is measured in the bench.
"""

from __future__ import annotations

from typing import Any

import torch

from policies.base import ChunkPolicy

DESIRED_ACTION_STD = 0.3
"""Below this spread of normalised actions steering gained little in pilot runs."""


@torch.no_grad()
def action_spread(
    policy: ChunkPolicy, observations: torch.Tensor, draws: int = 16, seed: int = 0
) -> dict[str, Any]:
    """Spread of the executed actions over the noise, at given observations.

    Actions are normalised by the policy's own statistics (1 is half the demonstrated range of a
    scalar, or the largest demonstrated norm of a vector). For each observation, executed step
    and number, take the standard deviation over ``draws`` standard normal noises; report means.

    Args:
        policy: the base policy.
        observations: ``[N, obs_dim]``, environment units; states that the policy visits.
        draws: noises per observation, at least 2.
        seed: of the noises.

    Returns:
        ``action_std`` (mean over all numbers), ``action_std_by_field`` (by action field),
        ``observations``, ``draws`` and ``seed``; JSON-ready.
    """
    count = len(observations)
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(
        draws, count, policy.horizon, policy.act_layout.dim, generator=generator
    ).to(observations)
    actions = torch.stack([policy.decode(observations, w) for w in noise])
    spread = policy.act_normalizer.normalize(actions[:, :, : policy.execute]).std(dim=0)
    layout = policy.act_layout
    return {
        "action_std": float(spread.mean()),
        "action_std_by_field": {
            field.name: float(spread[..., layout.slice(field.name)].mean())
            for field in layout.fields
        },
        "observations": count,
        "draws": draws,
        "seed": seed,
    }
