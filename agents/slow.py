"""A slow free path beside every equivariant layer (ours): symmetric first, free later.

Every layer is the sum of an equivariant layer and a plain one that starts at 0,

    W = W_strict + rate V,

and V is trained like all parameters. A step of Adam moves a number of V by about lr for any size of
its gradient, so that the plain path moves at ``rate`` times the learning rate. Nothing pulls it
back. A penalty would have to undo steps that are as large in the plain path as in the strict one
from the first update on. The dial: rate 0 is the equivariant agent, bit for bit; at 1 both paths
are equally fast, as in ``residual-pathway`` without a penalty.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import nn

from symsteer.agents.asymmetry import AsymmetricAgent, TwoPaths
from symsteer.agents.networks import Parameters
from symsteer.agents.options import SacOptions
from symsteer.agents.presets import defaults_of
from symsteer.agents.sac import VALUE
from symsteer.policies.geometry import Layout


@dataclass(frozen=True)
class SlowOptions(SacOptions):
    """Options of the slow agent."""

    rate: float = 0.03
    """The dial: speed of the plain path relative to the strict one. 0: strict; 1: equally fast."""
    bias_speed: float = 1.0
    """Factor on the rate of the biases."""
    critic_speed: float = 1.0
    """Factor on the rate of the critics."""
    start: int = 0
    """Updates of a network before its plain path moves."""
    shared: bool = False
    """Whether Adam divides steps of the plain path by the gradients of the strict one: a gradient
    that is as small as noise then makes a small step."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require(
            "not be negative",
            lambda value: value >= 0,
            *("rate", "bias_speed", "critic_speed", "start"),
        )


class Slow(TwoPaths):
    """The sum of both paths.

    Attributes:
        rate, bias_rate: factors on the matrix and the bias of the plain path.
    """

    rate = bias_rate = 1.0

    def dense_of(self, parameters: Parameters) -> tuple[torch.Tensor, torch.Tensor]:
        weight, bias = self.strict_of(parameters)
        weight = weight.add(parameters["free.weight"], alpha=self.rate)
        return weight, bias.add(parameters["free.bias"], alpha=self.bias_rate)


@defaults_of("tuned")
class SlowAgent(AsymmetricAgent):
    """The equivariant agent with a slow plain path beside every layer."""

    name = "slow"
    in_teams = True
    Options = SlowOptions
    options: SlowOptions
    Layer = Slow

    def layers(self, inputs: Layout, outputs: Layout, scale: float = 1.0) -> list[nn.Module]:
        rate = self.options.rate * (self.options.critic_speed if outputs is VALUE else 1.0)
        layers = super().layers(inputs, outputs, scale)
        for layer in layers:
            assert isinstance(layer, Slow)
            layer.rate, layer.bias_rate = rate, rate * self.options.bias_speed
        return layers

    def settle(self, name: str) -> None:
        """Hold the plain path at 0 before its start; give it the strict path's second moments."""
        optimizer = self.optimizers[name]
        begun = optimizer.steps > self.options.start
        squares = iter(optimizer.moments["exp_avg_sq"])
        for _, parameters in self.networks[name].layers():
            mean = {}
            for part, numbers in parameters.items():
                path, kind = part.split(".", 1)
                square = next(squares)
                if path == "strict":
                    dims = tuple(range(1, square.dim()))
                    mean[kind] = square.mean(dims)
                    continue
                numbers.mul_(begun)
                if self.options.shared:
                    square.copy_(mean[kind].view(-1, *[1] * (square.dim() - 1)).expand_as(square))
