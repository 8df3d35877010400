"""What a diffusion policy needs of its network."""

from __future__ import annotations

import abc
import copy
import math
from typing import Self

import torch
from torch import nn
from torch.nn import functional

from symsteer.policies.geometry import Group

TIME_FEATURES = 64


class Denoiser(nn.Module, abc.ABC):
    """Predicts a clean chunk (or its noise) from a noisy one.

    The observation is encoded once per call of the sampler, the noise levels once for all.

    Attributes:
        group: the finite group with which the network commutes exactly; C1 for none.
    """

    group: Group

    @abc.abstractmethod
    def encode(self, obs: torch.Tensor) -> torch.Tensor:
        """What the network sees of the observation; ``[B, obs_dim] -> [B, ...]``."""

    def encode_time(self, t: torch.Tensor) -> torch.Tensor:
        """What it sees of the noise level; ``[B] -> [B, ...]``.

        By default the numbers of :meth:`add_time_layers`, from sines and cosines at many rates.
        """
        half = TIME_FEATURES // 2
        rates = torch.exp(
            torch.arange(half, device=t.device, dtype=torch.float64) * (-math.log(1e4) / half)
        )
        phases = t[:, None].double() * rates
        features = torch.cat([phases.sin(), phases.cos()], dim=-1).to(self.time_in.weight.dtype)
        return self.time_out(functional.silu(self.time_in(features)))

    def add_time_layers(self, numbers: int) -> None:
        """Make the layers of :meth:`encode_time`, which then gives ``[B, numbers]``."""
        self.time_in = nn.Linear(TIME_FEATURES, TIME_FEATURES)
        self.time_out = nn.Linear(TIME_FEATURES, numbers, bias=False)

    @abc.abstractmethod
    def forward(self, x: torch.Tensor, context: torch.Tensor, time: torch.Tensor) -> torch.Tensor:
        """Predict; ``x [B, Tp, Da]``, what the encoders give -> ``[B, Tp, Da]``.

        ``time`` has B rows, or one for all.
        """

    def output_layers(self) -> list[nn.Module]:
        """Layers with which the prediction is 0 if all of their parameters are; may be none."""
        return []

    def expanded(self) -> Self:
        """A copy for inference; subclasses compute here what is the same in every call."""
        return copy.deepcopy(self).requires_grad_(False).eval()


def parameter_count(module: nn.Module) -> int:
    """Trainable numbers of a module."""
    return sum(p.numel() for p in module.parameters())
