"""A control: the equivariant agent with the wrong symmetry.

It is the equivariant agent in every respect, but mirrors the noise (and the actions that critics
judge): if the scene is rotated by an angle, its noise rotates by minus this angle. It has the size,
the weight sharing and the learning rates of the equivariant agent, without the true symmetry. If it
did as well, the symmetry would not be what helps.
"""

from __future__ import annotations

import torch
from torch import nn

from symsteer.agents.equivariant import EquivariantAgent
from symsteer.agents.networks import Parameters, dense_of, within
from symsteer.policies.geometry import Layout
from symsteer.policies.networks.equivariant import MatrixLayer


class WrongGroupAgent(EquivariantAgent):
    """Equivariant under rotations that turn observations and noise in opposite directions."""

    name = "wrong-group"
    in_teams = True
    role = "control"

    def actor_layers(self) -> list[nn.Module]:
        *layers, last = super().actor_layers()
        return [*layers, Mirrored(last, mirror(self.actor_layout), outputs=True)]

    def critic_layers(self, inputs: Layout) -> list[nn.Module]:
        first, *layers = super().critic_layers(inputs)
        matrix, seen = mirror(inputs), self.obs_layout.dim
        matrix[:seen, :seen] = torch.eye(seen)  # the observation stays as it is
        return [Mirrored(first, matrix, outputs=False), *layers]


def mirror(layout: Layout) -> torch.Tensor:
    """The reflection at the x axis, ``[dim, dim]``; it turns rotations into their inverses."""
    return layout.matrix(0.0, reflect=True, dtype=torch.get_default_dtype())


class Mirrored(MatrixLayer):
    """A layer whose inputs or outputs are multiplied by a fixed matrix."""

    matrix: torch.Tensor

    def __init__(self, layer: nn.Module, matrix: torch.Tensor, outputs: bool):
        super().__init__()
        self.layer, self.outputs = layer, outputs
        self.register_buffer("matrix", matrix, persistent=False)

    def dense_of(self, parameters: Parameters) -> tuple[torch.Tensor, torch.Tensor]:
        weight, bias = dense_of(self.layer, within("layer", parameters))
        if self.outputs:
            return self.matrix @ weight, bias @ self.matrix.mT
        return weight @ self.matrix, bias
