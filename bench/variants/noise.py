"""Random numbers that are functions of two integers: equal on any device, in any order."""

from __future__ import annotations

import math

import torch


def uniform(key: torch.Tensor, step: torch.Tensor | int) -> torch.Tensor:
    """Uniform numbers in (0, 1), ``[N]`` float64, for integers ``key [N]`` and ``step``."""
    return _uniform(_mix(_mix(key) + step))


def normal_pairs(key: torch.Tensor, step: torch.Tensor) -> torch.Tensor:
    """Two independent standard normal numbers ``[N, 2]`` for integers ``key`` and ``step [N]``."""
    state = _mix(_mix(key) + step)
    # Box and Muller's transform.
    u = [_uniform(_mix(state + i)) for i in (1, 2)]
    radius, angle = (-2 * u[0].log()).sqrt(), 2 * math.pi * u[1]
    return torch.stack([radius * angle.cos(), radius * angle.sin()], dim=1).float()


def _uniform(bits: torch.Tensor) -> torch.Tensor:
    """Numbers in (0, 1) from scrambled int64."""
    return (bits >> 11 & (2**53 - 1)).double().add(0.5) / 2**53


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
