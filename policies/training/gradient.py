"""What all policies share that are trained by gradient descent on demonstrated chunks.

A subclass says in :meth:`GradientPolicy.loss` what it learns from a batch, and how it decodes.
"""

from __future__ import annotations

import abc
import time
from collections.abc import Sequence
from typing import Any, Self

import torch

from symsteer.policies.contract import ChunkPolicy, Episode, Progress
from symsteer.policies.geometry import Layout
from symsteer.policies.normalizer import Normalizer, clip_blocks
from symsteer.policies.training.demonstrations import check_episodes, make_chunks
from symsteer.policies.training.optimizer import GradientOptions, optimize


class GradientPolicy(ChunkPolicy):
    """A policy whose parameters minimise a loss on batches of observations and chunks.

    The constructor must take exactly options, layouts and normalisers, in this order.
    """

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
    def pairs(
        cls, options: Any, episodes: Sequence[Episode], act_layout: Layout
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """What is trained on: ``obs [M, obs_dim]`` and the bounded ``chunks [M, Tp, act_dim]``."""
        obs, chunks = make_chunks(episodes, act_layout, options.horizon, options.hold)
        # The environment bounds actions block by block: train on what it executes.
        return obs, clip_blocks(chunks, cls.bounded_layout(act_layout), 1.0)

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
        """Train on batches drawn with replacement; see :meth:`ChunkPolicy.fit`.

        The optimiser is :func:`symsteer.policies.training.optimizer.optimize`.
        """
        check_episodes(episodes, obs_layout, act_layout)
        start = time.perf_counter()
        obs, chunks = cls.pairs(options, episodes, act_layout)
        generator = torch.Generator().manual_seed(seed)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            policy = cls(
                options,
                obs_layout,
                act_layout,
                Normalizer.fit(cls.bounded_layout(obs_layout), obs),
                Normalizer.fit(cls.bounded_layout(act_layout), chunks),
            )
        options = policy.options
        policy.to(device)
        obs, chunks = obs.to(device), policy.act_normalizer.normalize(chunks.to(device))

        def batch_loss() -> torch.Tensor:
            rows = torch.randint(len(obs), (options.batch_size,), generator=generator).to(device)
            return policy.loss(obs[rows], chunks[rows], generator)

        losses = optimize(policy, batch_loss, options, progress)
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
        return policy.freeze()
