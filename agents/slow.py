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

    rate: float = 0.3
    """The dial: speed of the plain path relative to the strict one. 0: strict; 1: equally fast."""
    critic_speed: float = 0.1
    """Factor on the rate of the critics."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require("not be negative", lambda value: value >= 0, "rate", "critic_speed")


class Slow(TwoPaths):
    """The sum of both paths.

    Attributes:
        rate: factor on the plain path.
    """

    rate = 1.0

    def dense_of(self, parameters: Parameters) -> tuple[torch.Tensor, torch.Tensor]:
        weight, bias = self.strict_of(parameters)
        weight = weight.add(parameters["free.weight"], alpha=self.rate)
        return weight, bias.add(parameters["free.bias"], alpha=self.rate)


@defaults_of("minimax")
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
            layer.rate = rate
        return layers
