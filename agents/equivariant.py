"""The equivariant agent: every linear map commutes with the group. If the scene is rotated, the
actor's noise rotates with it and the critics' values do not change.

Actor: lift, group convolutions, projection to the chunk's irreps (means) and to one scalar per
irrep block (scales). Critics: the same trunk for observation and noise, pooled over the group axis.
The last layer of both is a :class:`Pool`; with a scalar output it is this pooling.
"""

from __future__ import annotations

import math

import torch
from torch import nn

from symsteer.agents.networks import Parameters, shrink_
from symsteer.agents.options import SacOptions
from symsteer.agents.presets import defaults_of
from symsteer.agents.sac import SacAgent
from symsteer.policies.geometry import Group, Layout
from symsteer.policies.networks.equivariant import Lift, Project, RegularLinear


class Pool(Project):
    """``Project`` as a sum over the group instead of a mean: y = sum_g rho(g) W f(g) + b.

    Adam changes every parameter by about ``lr`` per step, for any size of the gradient. A mean
    would divide this step by |G| in the dense matrix: the output layer would learn |G| times slower
    than a plain layer. With a sum, both change equally fast. The initial weights have the bound of
    a plain layer with |G| * channels inputs.
    """

    def __init__(self, group: Group, channels: int, layout: Layout):
        super().__init__(group, channels, layout)
        with torch.no_grad():
            self.weight.div_(math.sqrt(group.order))
            self.bias.div_(math.sqrt(group.order))

    def dense_of(self, parameters: Parameters) -> tuple[torch.Tensor, torch.Tensor]:
        weight, bias = super().dense_of(parameters)
        return weight * self.group.order, bias


@defaults_of("minimax")
class EquivariantAgent(SacAgent):
    """Equivariant actor and invariant critics, exact for every element of ``group``."""

    name = "equivariant"
    in_teams = True

    def layers(self, inputs: Layout, outputs: Layout, scale: float = 1.0) -> list[nn.Module]:
        return equivariant_layers(inputs, outputs, self.options, scale)


def equivariant_layers(
    inputs: Layout, outputs: Layout, options: SacOptions, scale: float = 1.0
) -> list[nn.Module]:
    """``depth`` hidden layers with width/|G| regular fields each, and an output layer.

    The parameters of the output layer are multiplied by ``scale``.
    """
    group = Group.parse(options.group)
    fields = max(1, round(options.width / group.order))
    layers: list[nn.Module] = [
        Lift(inputs, group, fields),
        *[RegularLinear(group, fields, fields) for _ in range(options.depth - 1)],
        Pool(group, fields, outputs),
    ]
    shrink_(layers[-1], scale)
    return layers
