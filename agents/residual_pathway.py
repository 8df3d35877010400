"""Residual pathway priors (RPP, arXiv 2112.01388): an equivariant and a plain path in every layer.

Every layer is the sum of an equivariant and a plain layer, and the plain path has the penalty
``|W_plain|^2``. It starts at 0. The paper also penalises the equivariant path, less; here nothing
holds it.
"""

from __future__ import annotations

import torch

from symsteer.agents.asymmetry import PenaltyAgent, TwoPaths
from symsteer.agents.networks import Parameters
from symsteer.agents.presets import defaults_of


class ResidualPathway(TwoPaths):
    """The sum of both paths."""

    def dense_of(self, parameters: Parameters) -> tuple[torch.Tensor, torch.Tensor]:
        weight, bias = self.strict_of(parameters)
        return weight + parameters["free.weight"], bias + parameters["free.bias"]

    def pull(self, parameters: Parameters, factor: torch.Tensor) -> None:
        for name in ("free.weight", "free.bias"):
            parameters[name].mul_(factor)


@defaults_of("minimax")
class ResidualPathwayAgent(PenaltyAgent):
    """The equivariant agent with a penalised plain path beside every layer."""

    name = "residual-pathway"
    in_teams = True
    Layer = ResidualPathway
