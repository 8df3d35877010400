"""A resilient constraint: a plain path of every layer is let in where the loss pays for it.

Every layer is W = W_eq + gamma W_free with a number gamma under the constraint |gamma| <= u. The
slack u costs price u^2 / 2 (resilient constrained learning, arXiv 2306.02426; for equivariant
layers arXiv 2505.13631). Descent on the Lagrangian and ascent on its
multiplier lambda alternate,

    L = J + sum lambda |gamma|,  lambda <- max(lambda + eta (|gamma| - u), 0),  u = lambda / price.

There gamma starts at 1 and is forced towards 0. Here gamma starts at 0 and lambda at a positive
number, so that the agent begins as the equivariant one. While gamma is 0, lambda falls; gamma grows
once the loss gains more by it than lambda. In equilibrium the gain is price |gamma|. Our choices:
where both start; W_free starts at random, with the norm of W_eq; Adam trains gamma like all
parameters.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import nn

from symsteer.agents.asymmetry import AsymmetricAgent
from symsteer.agents.constrained import Constrained
from symsteer.agents.networks import dense, shrink_
from symsteer.agents.options import SacOptions
from symsteer.agents.presets import tuned
from symsteer.agents.replay import Batch
from symsteer.policies.geometry import Layout
from symsteer.policies.networks.equivariant import EquivariantLayer


@dataclass(frozen=True)
class ResilientOptions(SacOptions):
    """Options of the resilient agent."""

    price: float = 1.0
    """The dial: price of the squared slack. Large: strict; 0: free."""
    initial_multiplier: float = 1.0
    """lambda at the start."""
    dual_lr: float = 1e-3
    """Rate eta of the ascent on the multipliers."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require("not be negative", lambda value: value >= 0, "initial_multiplier", "dual_lr")
        self._require("be positive", lambda value: value > 0, "price")


class Resilient(Constrained):
    """The layer of ``constrained`` with gamma = 0 and a plain path that is not 0."""

    def __init__(self, strict: EquivariantLayer):
        super().__init__(strict)
        with torch.random.fork_rng(devices=[]):
            self.free.reset_parameters()
        size = dense(strict)[0].norm() / self.free.weight.norm()
        shrink_(self.free, size.item())
        nn.init.zeros_(self.gamma)


@tuned
class ResilientAgent(AsymmetricAgent):
    """The equivariant agent with a plain part in every layer, which has to pay for itself."""

    name = "resilient"
    in_teams = True
    Options = ResilientOptions
    options: ResilientOptions
    Layer = Resilient

    def layers(self, inputs: Layout, outputs: Layout, scale: float = 1.0) -> list[nn.Module]:
        layers = super().layers(inputs, outputs, scale)
        for layer in layers:
            assert isinstance(layer, Resilient)
            nn.init.constant_(layer.multiplier, self.options.initial_multiplier)
        return layers

    def penalty(self, name: str, batch: Batch) -> torch.Tensor | None:
        """The part of the Lagrangian that depends on gamma."""
        terms = [
            (layer["multiplier"].detach() * layer["gamma"].abs()).sum(-1)
            for _, layer in self.networks[name].layers()
        ]
        return torch.stack(terms).sum(0)

    def settle(self, name: str) -> None:
        """One step of dual ascent."""
        for _, layer in self.networks[name].layers():
            gamma, multiplier = layer["gamma"], layer["multiplier"]
            slack = multiplier / self.options.price
            multiplier.add_(gamma.abs() - slack, alpha=self.options.dual_lr).clamp_(min=0)
