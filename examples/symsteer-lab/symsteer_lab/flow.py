"""A base policy by conditional flow matching (arXiv 2210.02747) with straight paths.

For noise w, a demonstrated chunk a and time t in [0, 1], let x_t = (1 - t) w + t a. A perceptron
v(x_t, t, s) learns the velocity a - w at the observation s. Decoding integrates dx/dt = v from
x_0 = w to t = 1 with a few Euler steps, so the noise alone decides which chunk comes out. The
perceptron knows no symmetry: the policy's group is C1.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import torch
from torch import nn

from symsteer.policies.contract import ChunkPolicy, Episode, Progress
from symsteer.policies.geometry import Layout
from symsteer.policies.normalizer import Normalizer, clip_blocks
from symsteer.policies.training.demonstrations import check_episodes, make_chunks
from symsteer.policies.training.optimizer import GradientOptions, optimize


@dataclass(frozen=True)
class FlowOptions(GradientOptions):
    """Options of the flow policy."""

    steps: int = 6000
    """Gradient steps."""
    width: int = 256
    """Features of a hidden layer."""
    depth: int = 3
    """Hidden layers."""
    euler_steps: int = 4
    """Steps of the integration from noise to chunk."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self.require_positive("width", "depth", "euler_steps")


class FlowPolicy(ChunkPolicy):
    """Conditional flow matching with a perceptron; it knows no symmetry."""

    name = "flow-mlp"
    Options = FlowOptions
    options: FlowOptions

    def __init__(
        self,
        options: FlowOptions,
        obs_layout: Layout,
        act_layout: Layout,
        obs_normalizer: Normalizer | None = None,
        act_normalizer: Normalizer | None = None,
    ):
        super().__init__(options, obs_layout, act_layout, obs_normalizer, act_normalizer)
        chunk = options.horizon * act_layout.dim
        sizes = [chunk + obs_layout.dim + 1, *[options.width] * options.depth]
        layers: list[nn.Module] = []
        for inputs, outputs in itertools.pairwise(sizes):
            layers += [nn.Linear(inputs, outputs), nn.SiLU()]
        self.network = nn.Sequential(*layers, nn.Linear(options.width, chunk))
        self.freeze()

    @classmethod
    def fit(
        cls,
        options: FlowOptions,
        episodes: Sequence[Episode],
        obs_layout: Layout,
        act_layout: Layout,
        seed: int = 0,
        progress: Progress | None = None,
        device: torch.device | str = "cpu",
    ) -> Self:
        """Regress velocities on random points of random paths; see :meth:`ChunkPolicy.fit`."""
        check_episodes(episodes, obs_layout, act_layout)
        start = time.perf_counter()
        obs, chunks = make_chunks(episodes, act_layout, options.horizon, options.hold)
        chunks = clip_blocks(chunks, act_layout, 1.0)  # what the environment executes
        generator = torch.Generator().manual_seed(seed)
        with torch.random.fork_rng(devices=[]):  # the caller's generator stays as it is
            torch.manual_seed(seed)
            policy = cls(
                options,
                obs_layout,
                act_layout,
                Normalizer.fit(obs_layout, obs),
                Normalizer.fit(act_layout, chunks),
            )
        policy.to(device)
        obs = policy.normalized_observation(obs.to(device))
        chunks = policy.act_normalizer.normalize(chunks.to(device))

        def batch_loss() -> torch.Tensor:
            rows = torch.randint(len(obs), (options.batch_size,), generator=generator).to(device)
            t = torch.rand(options.batch_size, 1, 1, generator=generator).to(device)
            goal = chunks[rows]
            noise = torch.randn(goal.shape, generator=generator).to(device)
            velocity = policy.velocity(torch.lerp(noise, goal, t), t, obs[rows])
            return (velocity - (goal - noise)).square().mean()

        losses = optimize(policy.network, batch_loss, options, progress)
        policy.training_record = {
            "seed": seed,
            "episodes": len(episodes),
            "chunks": len(obs),
            "losses": losses,
            "seconds": time.perf_counter() - start,
        }
        return policy.freeze()

    def velocity(self, x: torch.Tensor, t: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        """The network's velocity at ``x [B, Tp, Da]``, ``t [B, 1, 1]``, normalised ``obs``."""
        inputs = torch.cat([x.flatten(1), obs, t.flatten(1)], dim=1)
        return self.network(inputs).view_as(x)

    def decode(self, obs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
        """Euler steps from the noise to a chunk; see :meth:`ChunkPolicy.decode`."""
        seen, x, steps = self.normalized_observation(obs), noise, self.options.euler_steps
        for step in range(steps):
            t = x.new_full((len(x), 1, 1), step / steps)
            x = x + self.velocity(x, t, seen) / steps
        return clip_blocks(self.act_normalizer.unnormalize(x), self.act_layout, 1.0)
