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
from symsteer.agents.networks import dense
from symsteer.policies.geometry import Layout


class WrongGroupAgent(EquivariantAgent):
    """Equivariant under rotations that turn observations and noise in opposite directions."""

    name = "wrong-group"
    in_teams = True
    role = "control"

    def actor_layers(self) -> list[nn.Module]:
        *layers, last = super().actor_layers()
        return [*layers, Mirrored(last, outputs=mirror(self.actor_layout))]

    def critic_layers(self, inputs: Layout) -> list[nn.Module]:
        first, *layers = super().critic_layers(inputs)
        matrix = mirror(inputs)
        seen = self.obs_layout.dim
        matrix[:seen, :seen] = torch.eye(seen)  # the observation stays as it is
        return [Mirrored(first, inputs=matrix), *layers]


def mirror(layout: Layout) -> torch.Tensor:
    """The reflection at the x axis, ``[dim, dim]``; it turns rotations into their inverses."""
    return layout.matrix(0.0, reflect=True, dtype=torch.get_default_dtype())


class Mirrored(nn.Module):
    """A layer whose inputs or outputs are multiplied by a fixed matrix."""

    inputs: torch.Tensor | None
    outputs: torch.Tensor | None

    def __init__(
        self,
        layer: nn.Module,
        inputs: torch.Tensor | None = None,
        outputs: torch.Tensor | None = None,
    ):
        super().__init__()
        self.layer = layer
        self.register_buffer("inputs", inputs, persistent=False)
        self.register_buffer("outputs", outputs, persistent=False)

    def dense(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Weight ``[out, in]`` and bias ``[out]``."""
        weight, bias = dense(self.layer)
        if self.inputs is not None:
            weight = weight @ self.inputs
        if self.outputs is not None:
            weight, bias = self.outputs @ weight, self.outputs @ bias
        return weight, bias
