"""Projection regularisation (arXiv 2601.05028): plain layers that are pulled to the symmetry.

Every layer is a plain matrix W with the penalty ``|W - P(W)|^2``, where P is the Reynolds
projection P(W) = mean_g rho_out(g)^-1 W rho_in(g). W starts as that of an equivariant layer.
The paper also penalises P(W); here nothing holds the symmetric part.
"""

from __future__ import annotations

import torch
from torch import nn

from symsteer.agents.asymmetry import AsymmetricLayer, PenaltyAgent
from symsteer.agents.networks import Parameters, dense
from symsteer.agents.presets import defaults_of
from symsteer.policies.networks.equivariant import EquivariantLayer


class Projected(AsymmetricLayer):
    """A plain layer; its asymmetric part is what the projection removes."""

    def __init__(self, strict: EquivariantLayer):
        super().__init__()
        self.weight, self.bias = (nn.Parameter(x.detach().clone()) for x in dense(strict))
        self.strict = strict.without_parameters()

    def dense_of(self, parameters: Parameters) -> tuple[torch.Tensor, torch.Tensor]:
        return parameters["weight"], parameters["bias"]

    def pull(self, parameters: Parameters, factor: torch.Tensor) -> None:
        tensors = parameters["weight"], parameters["bias"]
        for tensor, near in zip(tensors, self.strict.nearest(*tensors), strict=True):
            tensor.lerp_(near, 1 - factor)


@defaults_of("tuned")
class ProjectedAgent(PenaltyAgent):
    """Plain layers that start equivariant and are pulled to their projections."""

    name = "projected"
    in_teams = True
    Layer = Projected
