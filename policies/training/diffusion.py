"""The diffusion process of the base policies: schedule, training loss, deterministic sampler.

Forward process q(x_t | x_0) = N(sqrt(a_t) x_0, (1 - a_t) I) with the squared-cosine schedule
(Nichol & Dhariwal, arXiv 2102.09672); sampling by DDIM with eta = 0 (Song et al., arXiv
2010.02502), so that the initial noise alone decides which action chunk comes out. Schedule,
time steps ("trailing") and step agree with diffusers' ``DDIMScheduler``
(``tests/policies/test_diffusion.py``); diffusers is not needed at run time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal, get_args

import torch

from symsteer.errors import UserError
from symsteer.names import unknown

Prediction = Literal["sample", "epsilon"]
Bound = Callable[[torch.Tensor], torch.Tensor]

MOST_STEPS = 10_000
"""Noise levels; published models use up to 1,000."""

MINIMUM_WEIGHT = 0.05
"""Least loss weight before normalisation. The sampler starts at the noisiest levels; without it
they would not be learned."""


class Diffusion:
    """Noise schedule, loss and sampler.

    Args:
        steps: K, the number of noise levels in training.
        prediction: what the network outputs: ``sample`` (the clean chunk x_0) or ``epsilon``
            (the noise). ``epsilon`` recovers x_0 by dividing by sqrt(a_t), which is about 5e-4
            at the first sampling step: rounding errors grow by 1/sqrt(a_t).
        snr_cap: with ``sample``, noise level t weighs min(SNR_t, snr_cap) in the loss, SNR_t =
            a_t / (1 - a_t) (Min-SNR, Hang et al., arXiv 2303.09556), at least
            ``MINIMUM_WEIGHT``, then scaled to a mean of 1. With equal weights the chunk depends
            less on the noise.

    Raises:
        UserError: if an argument is out of range.
    """

    def __init__(self, steps: int = 100, prediction: Prediction = "sample", snr_cap: float = 5.0):
        if not 2 <= steps <= MOST_STEPS:
            raise UserError(f"diffusion needs 2 to {MOST_STEPS} noise levels, not {steps}")
        if prediction not in get_args(Prediction):
            raise unknown("prediction", prediction, get_args(Prediction))
        if not snr_cap > 0:
            raise UserError(f"snr_cap must be positive, not {snr_cap}")
        self.steps = steps
        self.prediction = prediction
        product = 1.0
        self.signal: list[float] = []
        for t in range(steps):
            beta = min(1 - _squared_cosine((t + 1) / steps) / _squared_cosine(t / steps), 0.999)
            product *= 1 - beta
            self.signal.append(product)
        weights = [1.0] * steps
        if prediction == "sample":
            weights = [max(min(a / (1 - a), snr_cap), MINIMUM_WEIGHT) for a in self.signal]
        self.weights = [weight * steps / sum(weights) for weight in weights]

    def timesteps(self, sampling_steps: int) -> list[int]:
        """Noise levels of the sampler, from K - 1 down, evenly spaced from the noisy end.

        Raises:
            UserError: unless 1 <= sampling_steps <= K.
        """
        if not 1 <= sampling_steps <= self.steps:
            raise UserError(
                f"the sampler can take 1 to {self.steps} steps (the noise levels in training), "
                f"not {sampling_steps}"
            )
        return [round(self.steps * (1 - i / sampling_steps)) - 1 for i in range(sampling_steps)]

    def add_noise(self, x0: torch.Tensor, noise: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        """Draw x_t given x_0; shapes ``x0, noise [B, ...]``, ``t [B]`` int64."""
        signal = torch.tensor(self.signal, dtype=torch.float64)
        shape = (-1,) + (1,) * (x0.dim() - 1)
        keep = signal.sqrt().to(x0)[t].view(shape)
        spread = (1 - signal).sqrt().to(x0)[t].view(shape)
        return keep * x0 + spread * noise

    def loss(
        self, output: torch.Tensor, x0: torch.Tensor, noise: torch.Tensor, t: torch.Tensor
    ) -> torch.Tensor:
        """Weighted mean squared error of the network's output at levels ``t [B]``, a scalar."""
        target = x0 if self.prediction == "sample" else noise
        weights = torch.tensor(self.weights, dtype=output.dtype, device=output.device)[t]
        return (weights * (output - target).square().flatten(1).mean(dim=1)).mean()

    def ddim_step(
        self,
        output: torch.Tensor,
        t: int,
        t_next: int,
        x: torch.Tensor,
        bound: Bound | None = None,
    ) -> torch.Tensor:
        """One deterministic step from noise level ``t`` to ``t_next`` (-1 is the clean chunk).

        Args:
            output: the network's prediction at ``x``.
            x: the noisy chunk, any shape.
            bound: applied to the predicted clean chunk; must commute with the symmetry. The
                noise direction is the one that belongs to the bounded prediction.
        """
        keep, spread = math.sqrt(self.signal[t]), math.sqrt(1 - self.signal[t])
        clean = output if self.prediction == "sample" else (x - spread * output) / keep
        if bound is not None:
            clean = bound(clean)
        if t_next < 0:
            return clean
        noise = (x - keep * clean) / spread
        signal = self.signal[t_next]
        return math.sqrt(signal) * clean + math.sqrt(1 - signal) * noise

    def sample(
        self,
        network: Callable[[torch.Tensor, int], torch.Tensor],
        noise: torch.Tensor,
        sampling_steps: int,
        bound: Bound | None = None,
    ) -> torch.Tensor:
        """Follow the deterministic sampler from ``noise``; ``network(x, t)`` predicts."""
        levels = self.timesteps(sampling_steps)
        x = noise
        for t, t_next in zip(levels, [*levels[1:], -1], strict=True):
            x = self.ddim_step(network(x, t), t, t_next, x, bound)
        return x


def _squared_cosine(time: float) -> float:
    return math.cos((time + 0.008) / 1.008 * math.pi / 2) ** 2
