"""The approximately equivariant agent: a residual pathway prior (RPP, arXiv 2112.01388).

Every layer is the sum of an equivariant map and a plain map. The plain (free) path starts near zero
and is penalised: loss + w_b |W_free|^2 + w_e |W_eq|^2 with w_b > w_e. If the free path is zero, the
agent is exactly equivariant. If the world breaks the symmetry, the free path can grow.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import nn

from symsteer.agents.episodes import Played
from symsteer.agents.equivariant import EquivariantAgent
from symsteer.agents.networks import Dense, dense, shrink_
from symsteer.agents.options import SacOptions
from symsteer.errors import UserError
from symsteer.policies.geometry import Layout


@dataclass(frozen=True)
class ApproximateOptions(SacOptions):
    """Options of the approximately equivariant agent."""

    free_penalty: float = 0.1
    """Weight of the squared free path, per network (w_b)."""
    equivariant_penalty: float = 0.0
    """Weight of the squared equivariant path (w_e, at most w_b)."""
    free_init: float = 0.01
    """Factor on the free path at initialisation."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.free_init >= 0:
            raise UserError(f"agent option free_init must not be negative, not {self.free_init}")
        if not 0 <= self.equivariant_penalty <= self.free_penalty:
            raise UserError(
                "agent options need 0 <= equivariant_penalty <= free_penalty, not "
                f"{self.equivariant_penalty} and {self.free_penalty}"
            )


class ResidualPathway(nn.Module):
    """The sum of an equivariant layer and a plain layer of the same shape."""

    def __init__(self, equivariant: nn.Module, free_init: float):
        super().__init__()
        self.equivariant = equivariant
        outputs, inputs = dense(equivariant)[0].shape
        self.free = Dense(inputs, outputs)
        shrink_(self.free, free_init)

    def dense(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Weight ``[out, in]`` and bias ``[out]``."""
        weight, bias = dense(self.equivariant)
        return weight + self.free.weight, bias + self.free.bias


class ApproximateAgent(EquivariantAgent):
    """The equivariant agent with a penalised free path beside every layer."""

    name = "approximate"
    in_teams = True
    Options = ApproximateOptions
    options: ApproximateOptions

    def actor_layers(self) -> list[nn.Module]:
        return [ResidualPathway(layer, self.options.free_init) for layer in super().actor_layers()]

    def critic_layers(self, inputs: Layout) -> list[nn.Module]:
        layers = super().critic_layers(inputs)
        return [ResidualPathway(layer, self.options.free_init) for layer in layers]

    def parameter_groups(self, network: nn.Module) -> list[dict[str, Any]]:
        # Adam adds weight_decay * W to the gradient. With weight_decay = 2 w it is that of w |W|^2.
        free, equivariant = paths(network)
        return [
            {"params": free, "weight_decay": 2 * self.options.free_penalty},
            {"params": equivariant, "weight_decay": 2 * self.options.equivariant_penalty},
        ]

    def diagnostics(self, played: Played) -> Mapping[str, float | None]:
        """Also, for each network, norm of the free path / norm of the equivariant path."""
        shares = {}
        for name, network in self.networks.items():
            free, equivariant = (
                torch.stack([p.detach().norm() for p in path]).norm() for path in paths(network)
            )
            shares[f"free_path_{name}"] = (free / equivariant).item()
        return {**super().diagnostics(played), **shares}


def paths(network: nn.Module) -> tuple[list[nn.Parameter], list[nn.Parameter]]:
    """Parameters of the free and of the equivariant path."""
    free, equivariant = [], []
    for module in network.modules():
        if isinstance(module, ResidualPathway):
            free += list(module.free.parameters())
            equivariant += list(module.equivariant.parameters())
    return free, equivariant
