"""Residual pathway priors (RPP, arXiv 2112.01388): an equivariant and a plain path in every layer.

Every layer is the sum of an equivariant and a plain layer, and the plain path has the penalty
``|W_plain|^2``. It starts at 0. The paper also penalises the equivariant path, less; here nothing
holds it.
"""

from __future__ import annotations

import torch
from torch import nn

from symsteer.agents.asymmetry import LayersOf, Parameters, PenaltyAgent, PulledLayer
from symsteer.agents.networks import Dense, dense, shrink_
from symsteer.policies.networks.equivariant import EquivariantLayer


class ResidualPathway(PulledLayer):
    """The sum of an equivariant layer and a plain layer of the same shape, which starts at 0."""

    def __init__(self, strict: EquivariantLayer):
        super().__init__()
        self.strict = strict
        outputs, inputs = dense(strict)[0].shape
        self.free = Dense(inputs, outputs)
        shrink_(self.free, 0.0)

    def dense(self) -> tuple[torch.Tensor, torch.Tensor]:
        weight, bias = dense(self.strict)
        return weight + self.free.weight, bias + self.free.bias

    def pull(self, parameters: Parameters, factor: float) -> None:
        for name in ("free.weight", "free.bias"):
            parameters[name].mul_(factor)


class ResidualPathwayAgent(PenaltyAgent):
    """The equivariant agent with a penalised plain path beside every layer."""

    name = "residual-pathway"
    in_teams = True

    def asymmetric_layers(self, make: LayersOf) -> list[nn.Module]:
        return [ResidualPathway(layer) for layer in make()]
