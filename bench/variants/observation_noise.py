"""The camera that sees the objects shakes."""

from __future__ import annotations

import math

import torch
from mani_skill.utils.structs import Pose

from symsteer.bench.variants.base import Role, Variant

STD_X, STD_Y = 0.01, 0.0025


class ObservationNoise(Variant):
    """Objects are reported with Gaussian noise, four times larger along x than along y.

    Standard deviations are 10 mm * strength along x and 2.5 mm * strength along y. The noise is
    new in every control step and the same for all objects of an environment, as of a camera that
    shakes. Tool and goal are reported exactly. The noise depends only on the episode's key (its
    seed, see ``SymmetricTask.episode_key``) and the elapsed steps: reading an observation twice
    gives the same one, on any device and with any number of environments.
    Breaks the observation, everywhere; the half turn and mirror images in the axes survive in
    distribution.
    """

    def perceive(self, pose: Pose, role: Role) -> Pose:
        if role != "object":
            return pose
        normal = _normal_pairs(self.env.episode_key, self.env.elapsed_steps)
        noise = normal * normal.new_tensor([STD_X, STD_Y]) * self.amount[:, None]
        seen = pose.p + torch.nn.functional.pad(noise, (0, 1))
        return Pose.create_from_pq(self.only_active(seen, pose.p), pose.q)


def _normal_pairs(key: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
    """Two independent standard normal numbers ``[N, 2]`` for integers ``key`` and ``step [N]``."""
    state = _mix(_mix(key) + step)
    # Uniform in (0, 1), then Box and Muller's transform.
    u = [(_mix(state + i) >> 11 & (2**53 - 1)).double().add(0.5) / 2**53 for i in (1, 2)]
    radius, angle = (-2 * u[0].log()).sqrt(), 2 * math.pi * u[1]
    return torch.stack([radius * angle.cos(), radius * angle.sin()], dim=1).float()


def _mix(x: torch.Tensor) -> torch.Tensor:
    """Scramble int64 bits: the finaliser of SplitMix64 (Steele, Lea and Flood, 2014)."""
    x = x.long() + _signed(0x9E3779B97F4A7C15)
    x = (x ^ _shift(x, 30)) * _signed(0xBF58476D1CE4E5B9)
    x = (x ^ _shift(x, 27)) * _signed(0x94D049BB133111EB)
    return x ^ _shift(x, 31)


def _shift(x: torch.Tensor, bits: int) -> torch.Tensor:
    """Logical shift to the right; torch's is arithmetic."""
    return (x >> bits) & (2 ** (64 - bits) - 1)


def _signed(x: int) -> int:
    """An unsigned 64-bit number as the int64 of the same bits."""
    return x - 2**64 if x >= 2**63 else x
