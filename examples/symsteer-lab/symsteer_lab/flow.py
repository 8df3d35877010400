"""A base policy by conditional flow matching (arXiv 2210.02747) with straight paths.

For noise w, a demonstrated chunk a and time t in [0, 1], let x_t = (1 - t) w + t a. A perceptron
v(x_t, t, s) learns the velocity a - w at the observation s. Decoding integrates dx/dt = v from
x_0 = w to t = 1 with a few Euler steps, so the noise alone decides which chunk comes out. The
perceptron knows no symmetry: the policy's group is C1.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import torch
from torch import nn

from symsteer.policies import GradientOptions, GradientPolicy, Layout, clip_blocks


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


class FlowPolicy(GradientPolicy):
    """Conditional flow matching with a perceptron; it knows no symmetry."""

    name = "flow-mlp"
    Options = FlowOptions
    options: FlowOptions

    def __init__(self, options: FlowOptions, obs_layout: Layout, act_layout: Layout):
        super().__init__(options, obs_layout, act_layout)
        chunk = options.horizon * act_layout.dim
        sizes = [chunk + obs_layout.dim + 1, *[options.width] * options.depth]
        layers: list[nn.Module] = []
        for inputs, outputs in itertools.pairwise(sizes):
            layers += [nn.Linear(inputs, outputs), nn.SiLU()]
        self.network = nn.Sequential(*layers, nn.Linear(options.width, chunk))
        self.freeze()

    def loss(
        self, obs: torch.Tensor, chunks: torch.Tensor, generator: torch.Generator
    ) -> torch.Tensor:
        """Regress velocities on random points of random paths; see :meth:`GradientPolicy.loss`."""
        t = torch.rand(len(chunks), 1, 1, generator=generator).to(obs.device)
        noise = torch.randn(chunks.shape, generator=generator).to(obs.device)
        seen = self.normalized_observation(obs)
        velocity = self.velocity(torch.lerp(noise, chunks, t), t, seen)
        return (velocity - (chunks - noise)).square().mean()

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
