"""Relaxed group convolutions (Wang et al., 2022; in RL: arXiv 2411.04225).

A layer has several equivariant filters, and each filter has a weight for each group element h:

    f'(g) = sum_h sum_l w_l(h) psi_l(g^-1 h) f(h).

If the weights of a filter are equal, the layer is equivariant. They start equal (in the published
code they start at random) and are pulled to their mean: the squared distance from it is, up to a
factor, that of all pairs w_l(g) - w_l(h), of which the paper takes absolute values. The first layer
has weights at the group elements of its output, all others at those of their input.

Without a penalty a layer is no plain one: a plain layer has a filter for every pair (g, h).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import nn

from symsteer.agents.asymmetry import AsymmetricLayer, PenaltyAgent, PenaltyOptions
from symsteer.agents.networks import Parameters, dense_of, shrink_, within
from symsteer.agents.presets import defaults_of
from symsteer.policies.networks.equivariant import EquivariantLayer, Lift


@dataclass(frozen=True)
class RelaxedOptions(PenaltyOptions):
    """Options of the relaxed agent."""

    filters: int = 2
    """Filters L of each layer."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require("be at least 1", lambda value: value >= 1, "filters")


class Relaxed(AsymmetricLayer):
    """A sum of equivariant layers of equal shape, each weighted by group element.

    Args:
        filters: the layers; they become smaller, so that the sum has the size of one.
    """

    def __init__(self, *filters: EquivariantLayer):
        super().__init__()
        self.filters = nn.ModuleList(filters)
        shrink_(self.filters, 1 / math.sqrt(len(filters)))
        self.weights = nn.Parameter(torch.ones(len(filters), filters[0].group.order))
        self.strict = filters[0].without_parameters()
        # The axis of the matrices [..., L, out, in] that the group elements divide.
        self.axis = -2 if isinstance(self.strict, Lift) else -1

    def dense_of(self, parameters: Parameters) -> tuple[torch.Tensor, torch.Tensor]:
        matrices, biases = zip(
            *(
                dense_of(layer, within(f"filters.{index}", parameters))
                for index, layer in enumerate(self.filters)
            ),
            strict=True,
        )
        stacked, weights = torch.stack(matrices, -3), parameters["weights"]
        each = stacked.shape[self.axis] // weights.shape[-1]
        weights = weights.repeat_interleave(each, dim=-1).unsqueeze(-3 - self.axis)
        return (stacked * weights).sum(-3), torch.stack(biases).sum(0)

    def pull(self, parameters: Parameters, factor: torch.Tensor) -> None:
        weights = parameters["weights"]
        weights.lerp_(weights.mean(-1, keepdim=True), 1 - factor)


@defaults_of("tuned")
class RelaxedAgent(PenaltyAgent):
    """The equivariant agent with a weight for each filter and group element."""

    name = "relaxed"
    in_teams = True
    Options = RelaxedOptions
    options: RelaxedOptions
    Layer = Relaxed

    @property
    def copies(self) -> int:
        """The filters."""
        return self.options.filters
