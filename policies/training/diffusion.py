"""How chunks become noise, the training loss, and the deterministic way back.

Level t mixes a clean chunk with noise, x_t = k_t x_0 + s_t noise:

- ``diffusion``: k_t^2 = a_t, s_t^2 = 1 - a_t with the squared-cosine schedule (Nichol & Dhariwal,
  arXiv 2102.09672). Schedule, time steps ("trailing") and step agree with diffusers'
  ``DDIMScheduler`` (``tests/policies/test_diffusion.py``); diffusers is not needed at run time.
- ``flow``: k_t = 1 - s_t, straight paths with the constant velocity noise - x_0 (flow matching,
  Lipman et al., arXiv 2210.02747).

Back it goes by DDIM with eta = 0 (Song et al., arXiv 2010.02502), so that the initial noise alone
decides which chunk comes out. On straight paths a step of DDIM is an Euler step along the velocity.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Literal, get_args

import torch

from symsteer.errors import UserError
from symsteer.names import check

Process = Literal["diffusion", "flow"]
Prediction = Literal["sample", "epsilon", "velocity"]
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
        prediction: what the network outputs: ``sample`` (the clean chunk x_0), ``epsilon`` (the
            noise; diffusion only) or ``velocity`` (noise - x_0; flow only). ``epsilon`` recovers
            x_0 by dividing by k_t, which is about 5e-4 at the first sampling step: rounding errors
            grow by 1/k_t.
        snr_cap: with ``sample``, noise level t weighs min(SNR_t, snr_cap) in the loss, SNR_t =
            k_t^2 / s_t^2 (Min-SNR, Hang et al., arXiv 2303.09556), at least
            ``MINIMUM_WEIGHT``, then scaled to a mean of 1. With equal weights the chunk depends
            less on the noise.
        process: ``diffusion`` or ``flow``.

    Attributes:
        keep, spread: k_t and s_t of every level.

    Raises:
        UserError: if an argument is out of range.
    """

    def __init__(
        self,
        steps: int = 100,
        prediction: Prediction = "sample",
        snr_cap: float = 5.0,
        process: Process = "diffusion",
    ):
        if not 2 <= steps <= MOST_STEPS:
            raise UserError(f"diffusion needs 2 to {MOST_STEPS} noise levels, not {steps}")
        check("prediction", [prediction], get_args(Prediction))
        check("process", [process], get_args(Process))
        if (prediction, process) in (("epsilon", "flow"), ("velocity", "diffusion")):
            own = "epsilon" if process == "diffusion" else "velocity"
            raise UserError(f"{process} predicts sample or {own}, not {prediction}; choose one")
        if not snr_cap > 0:
            raise UserError(f"snr_cap must be positive, not {snr_cap}")
        self.steps = steps
        self.prediction = prediction
        self.keep, self.spread = _cosine(steps) if process == "diffusion" else _straight(steps)
        weights = [1.0] * steps
        if prediction == "sample":
            ratios = [(k / s) ** 2 for k, s in zip(self.keep, self.spread, strict=True)]
            weights = [max(min(ratio, snr_cap), MINIMUM_WEIGHT) for ratio in ratios]
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
        """x_t of x_0; shapes ``x0, noise [B, ...]``, ``t [B]`` int64."""
        keep, spread = self.mixture(t, x0)
        return keep * x0 + spread * noise

    def mixture(self, t: torch.Tensor, like: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """k_t and s_t of levels ``t [B]``, with as many dimensions as ``like [B, ...]``."""
        shape = (-1,) + (1,) * (like.dim() - 1)
        keep, spread = (
            torch.tensor(values, dtype=torch.float64).to(like)[t].view(shape)
            for values in (self.keep, self.spread)
        )
        return keep, spread

    def loss(
        self, output: torch.Tensor, x0: torch.Tensor, noise: torch.Tensor, t: torch.Tensor
    ) -> torch.Tensor:
        """Weighted mean squared error of the network's output at levels ``t [B]``, a scalar."""
        target = {"sample": x0, "epsilon": noise, "velocity": noise - x0}[self.prediction]
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
        keep, spread = self.keep[t], self.spread[t]
        clean = output
        if self.prediction == "epsilon":
            clean = (x - spread * output) / keep
        elif self.prediction == "velocity":
            clean = x - spread * output
        if bound is not None:
            clean = bound(clean)
        if t_next < 0:
            return clean
        noise = (x - keep * clean) / spread
        return self.keep[t_next] * clean + self.spread[t_next] * noise

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


def _cosine(steps: int) -> tuple[list[float], list[float]]:
    product, signal = 1.0, []
    for t in range(steps):
        beta = min(1 - _squared_cosine((t + 1) / steps) / _squared_cosine(t / steps), 0.999)
        product *= 1 - beta
        signal.append(product)
    return [math.sqrt(a) for a in signal], [math.sqrt(1 - a) for a in signal]


def _straight(steps: int) -> tuple[list[float], list[float]]:
    return [1 - (t + 1) / steps for t in range(steps)], [(t + 1) / steps for t in range(steps)]


def _squared_cosine(time: float) -> float:
    return math.cos((time + 0.008) / 1.008 * math.pi / 2) ** 2
