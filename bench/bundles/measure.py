"""What a base policy that is taken away can do: success, equivariance of decoding, steerability."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import torch
from scipy.stats import binomtest

from symsteer.bench.runs.base_study import held_out_episodes, unbroken, visited_states
from symsteer.bench.runs.config import RunConfig
from symsteer.errors import UserError
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.geometry import Group
from symsteer.policies.steerability import decode_error


@dataclass(frozen=True)
class Measured:
    """What a base policy can do.

    Attributes:
        success: share of the held-out episodes that it solves with noise from N(0, I).
        interval: 95 % Wilson interval of it.
        successes, episodes: the numbers that it comes from.
        group: of the equivariance error: the policy's, or C8 if it keeps no symmetry.
        equivariance_error: of decoding; max over g of rms ||decode(gs, gw) - g decode(s, w)|| over
            rms ||decode(s, w)||, on visited states.
        steerability: the report of the policy's file.
    """

    success: float
    interval: tuple[float, float]
    successes: int
    episodes: int
    group: str
    equivariance_error: float
    steerability: dict[str, Any]

    def to_json(self) -> dict[str, Any]:
        """Plain data; the error with three digits, because the last ones are rounding."""
        error = float(f"{self.equivariance_error:.2e}")
        return {**asdict(self), "interval": list(self.interval), "equivariance_error": error}


@torch.no_grad()
def measure(config: RunConfig, policy: ChunkPolicy) -> Measured:
    """Play the held-out episodes and compare decoding with its turned copies.

    Args:
        config: task, embodiment, seed of the noise and number of episodes
            (``evaluation.final_episodes``).
        policy: the base policy, on the CPU.

    Raises:
        UserError: if a part of the policy's steerability report is missing.
    """
    report = policy.report.get("steerability") or {}
    if None in map(report.get, ("solvable", "states", "draws", "action_std")):
        raise UserError(
            "the file of the base policy lacks a part of its steerability report, which the card "
            "shows; export it from the run that made it"
        )
    seed, episodes = config.policy_seed, config.evaluation.final_episodes
    with unbroken(config, policy, episodes) as env:
        played = held_out_episodes(env, policy, seed, episodes)
    successes = int(played.episodes["success_once"].sum())
    sure = binomtest(successes, episodes).proportion_ci(method="wilson")
    group = policy.group if policy.group.order > 1 else Group.parse("C8")
    return Measured(
        success=successes / episodes,
        interval=(round(float(sure.low), 4), round(float(sure.high), 4)),
        successes=successes,
        episodes=episodes,
        group=str(group),
        equivariance_error=decode_error(policy, visited_states(played), group, seed),
        steerability=report,
    )
