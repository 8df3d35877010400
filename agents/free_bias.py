"""Equivariant weights, free biases (ours): a constant shift of the world can be undone, no more.

The bias of an equivariant layer is the same for all group elements. Here the biases may differ,

    y = W x + b + c,   W and b equivariant, c any vector, 0 at the start.

A first layer then sees a shifted input, W (x + s) + b = W x + b + W s, and a last layer can add a
constant vector to the noise, with a few dozen numbers. All else stays symmetric. This is the
networks' form of a learned symmetry-breaking input (Smidt et al., arXiv 2007.02005).

Their asymmetry in the record (``asymmetry_actor``) says how much of it was used.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import nn

from symsteer.agents.asymmetry import AsymmetricLayer, PenaltyAgent, PenaltyOptions
from symsteer.agents.networks import Parameters, dense, dense_of, within
from symsteer.agents.presets import defaults_of
from symsteer.policies.networks.equivariant import EquivariantLayer


@dataclass(frozen=True)
class FreeBiasOptions(PenaltyOptions):
    """Options of the agent with free biases."""

    penalty: float = 0.0


class FreeBias(AsymmetricLayer):
    """An equivariant layer plus a bias without symmetry."""

    def __init__(self, strict: EquivariantLayer):
        super().__init__()
        self.strict = strict
        self.free_bias = nn.Parameter(torch.zeros_like(dense(strict)[1]))

    def dense_of(self, parameters: Parameters) -> tuple[torch.Tensor, torch.Tensor]:
        weight, bias = dense_of(self.strict, within("strict", parameters))
        return weight, bias + parameters["free_bias"]

    def pull(self, parameters: Parameters, factor: torch.Tensor) -> None:
        parameters["free_bias"].mul_(factor)


@defaults_of("minimax")
class FreeBiasAgent(PenaltyAgent):
    """The equivariant agent with free biases."""

    name = "free-bias"
    in_teams = True
    Options = FreeBiasOptions
    Layer = FreeBias
