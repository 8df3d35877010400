"""The optimiser of base policies: AdamW, warm-up and cosine decay, averaged weights."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import nn

from symsteer.errors import UserError
from symsteer.policies.contract import PolicyOptions, Progress

RECORDED_POINTS = 100


@dataclass(frozen=True)
class GradientOptions(PolicyOptions):
    """Options of policies that are trained by gradient descent."""

    steps: int = 1500
    """Gradient steps."""
    batch_size: int = 128
    """Chunks in a gradient step."""
    learning_rate: float = 1e-3
    """Peak learning rate of AdamW; cosine decay to zero."""
    weight_decay: float = 1e-4
    """Weight decay of AdamW."""
    warmup_steps: int = 100
    """Gradient steps of linear warm-up."""
    ema_decay: float = 0.995
    """Decay of the averaged weights that the policy keeps; (1 + n)/(10 + n) while that is less."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_positive("steps", "batch_size")
        if not (self.learning_rate > 0 and self.weight_decay >= 0 and self.warmup_steps >= 0):
            raise UserError(
                "a base policy needs learning_rate > 0, weight_decay >= 0 and warmup_steps >= 0"
            )
        if not 0 <= self.ema_decay < 1:
            raise UserError(f"ema_decay must lie in [0, 1), not {self.ema_decay}")


def optimize(
    network: nn.Module,
    batch_loss: Callable[[], torch.Tensor],
    options: GradientOptions,
    progress: Progress | None = None,
) -> list[tuple[int, float]]:
    """Train a network; it ends up with the exponential average of its weights.

    Args:
        network: whose parameters are trained.
        batch_loss: draws a batch and returns the loss on it, a scalar.
        options: number of steps, rates and decays.
        progress: called about 100 times as ``progress(step, steps, loss)``.

    Returns:
        About 100 pairs (step, mean loss since the last pair).
    """
    average = [p.detach().clone() for p in network.parameters()]
    network.requires_grad_(True).train()
    parameters: list[torch.Tensor] = list(network.parameters())
    optimizer = torch.optim.AdamW(
        parameters,
        lr=options.learning_rate,
        betas=(0.95, 0.999),
        weight_decay=options.weight_decay,
        fused=True,
    )
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, lambda step: _rate(step, options))
    every = max(1, options.steps // RECORDED_POINTS)
    losses: list[tuple[int, float]] = []
    running = torch.zeros((), device=parameters[0].device)
    for step in range(1, options.steps + 1):
        loss = batch_loss()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(parameters, 1.0)
        optimizer.step()
        schedule.step()
        decay = min(options.ema_decay, (1 + step) / (10 + step))
        with torch.no_grad():
            torch._foreach_lerp_(average, parameters, 1 - decay)
            running += loss
        if step % every == 0 or step == options.steps:
            count = step - (losses[-1][0] if losses else 0)
            losses.append((step, float(running) / count))
            running.zero_()
            if progress is not None:
                progress(step, options.steps, losses[-1][1])
    with torch.no_grad():
        for parameter, value in zip(parameters, average, strict=True):
            parameter.copy_(value)
    return losses


def _rate(step: int, options: GradientOptions) -> float:
    """Learning-rate factor at a step: linear warm-up, then half a cosine to zero."""
    if step < options.warmup_steps:
        return (step + 1) / options.warmup_steps
    done = (step - options.warmup_steps) / max(1, options.steps - options.warmup_steps)
    return 0.5 * (1 + math.cos(math.pi * min(done, 1.0)))
