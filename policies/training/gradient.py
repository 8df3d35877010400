"""What all policies share that are trained by gradient descent on demonstrated chunks.

A subclass says in :meth:`GradientPolicy.loss` what it learns from a batch, and how it decodes. The
optimiser is AdamW with warm-up and cosine decay; the weights are averaged.
"""

from __future__ import annotations

import abc
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Self

import torch
from torch import nn

from symsteer.errors import UserError
from symsteer.policies.contract import ChunkPolicy, Episode, PolicyOptions, Progress
from symsteer.policies.geometry import Layout
from symsteer.policies.normalizer import Normalizer, clip_blocks
from symsteer.policies.training.demonstrations import check_episodes, make_chunks

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


class GradientPolicy(ChunkPolicy):
    """A policy whose parameters minimise a loss on batches of observations and chunks."""

    Options = GradientOptions
    options: Any

    @abc.abstractmethod
    def loss(
        self, obs: torch.Tensor, chunks: torch.Tensor, generator: torch.Generator
    ) -> torch.Tensor:
        """The loss on a batch, a scalar.

        Args:
            obs: ``[B, obs_dim]``, environment units.
            chunks: ``[B, Tp, act_dim]``, normalised demonstrated chunks that follow.
            generator: for all random draws. It is on the CPU, so that a seed means the same on
                every device; move what is drawn to ``obs.device``.
        """

    @classmethod
    def told_by_data(cls, options: Any, episodes: Sequence[Episode], obs_layout: Layout) -> Any:
        """Options in which everything that depends on the demonstrations is filled in."""
        return options

    @classmethod
    def pairs(
        cls, options: Any, episodes: Sequence[Episode], act_layout: Layout
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """What is trained on: ``obs [M, obs_dim]`` and the bounded ``chunks [M, Tp, act_dim]``."""
        obs, chunks = make_chunks(episodes, act_layout, options.horizon, options.hold)
        # The environment bounds actions block by block: train on what it executes.
        return obs, clip_blocks(chunks, cls.bounded_layout(act_layout), 1.0)

    def observation_statistics(self, obs: torch.Tensor) -> Normalizer:
        """Of demonstrated observations ``[M, task_layout.dim]``."""
        return Normalizer.fit(self.bounded_layout(self.obs_layout), obs)

    def finish(self, obs: torch.Tensor) -> None:
        """What is to be learned from demonstrated observations after the training."""

    @classmethod
    def fit(
        cls,
        options: Any,
        episodes: Sequence[Episode],
        obs_layout: Layout,
        act_layout: Layout,
        seed: int = 0,
        progress: Progress | None = None,
        device: torch.device | str = "cpu",
    ) -> Self:
        """Train on batches drawn with replacement; see :meth:`ChunkPolicy.fit`."""
        check_episodes(episodes, obs_layout, act_layout)
        start = time.perf_counter()
        options = cls.told_by_data(options, episodes, obs_layout)
        obs, chunks = cls.pairs(options, episodes, act_layout)
        generator = torch.Generator().manual_seed(seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            policy = cls(options, obs_layout, act_layout)
        policy.obs_normalizer = policy.observation_statistics(obs)
        policy.act_normalizer = Normalizer.fit(cls.bounded_layout(act_layout), chunks)
        options = policy.options
        policy.to(device)
        obs, chunks = obs.to(device), policy.act_normalizer.normalize(chunks.to(device))

        def batch_loss() -> torch.Tensor:
            rows = torch.randint(len(obs), (options.batch_size,), generator=generator).to(device)
            return policy.loss(obs[rows], chunks[rows], generator)

        losses = optimize(policy, batch_loss, options, progress)
        policy.freeze().finish(obs)
        policy.training_record = {
            "seed": seed,
            "episodes": len(episodes),
            "chunks": len(obs),
            "steps": options.steps,
            "losses": losses,
            "seconds": time.perf_counter() - start,
            "threads": torch.get_num_threads(),
            "device": str(device),
            "parameters": policy.parameter_count(),
        }
        return policy


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
