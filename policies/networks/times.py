"""What networks see of a noise level."""

from __future__ import annotations

import math

import torch

TIME_FEATURES = 64


def time_features(t: torch.Tensor, dtype: torch.dtype) -> torch.Tensor:
    """Sines and cosines of levels ``t [B]`` at many rates, ``[B, TIME_FEATURES]``."""
    half = TIME_FEATURES // 2
    rates = torch.exp(
        torch.arange(half, device=t.device, dtype=torch.float64) * (-math.log(1e4) / half)
    )
    phases = t[:, None].double() * rates
    return torch.cat([phases.sin(), phases.cos()], dim=-1).to(dtype)
