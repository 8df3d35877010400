"""Constrained equivariance (ACE, arXiv 2505.13631): the asymmetric part is trained away.

Every layer is W = W_eq + gamma W_neq with a number gamma that starts at 1, under the constraint
gamma = 0. Descent on the Lagrangian and ascent on its multiplier lambda alternate:

    equality:  L = J + sum lambda gamma,              lambda <- lambda + eta gamma,
    elastic:   L = J + sum lambda (|gamma| - u) + u^2 / 2,   u = lambda,
               lambda <- max(lambda + eta (|gamma| - u), 0).

``elastic`` leaves a gamma where the constraint costs too much. These are the updates of the paper;
those of its published code differ. Our choices: the weight of u^2; gamma is trained by Adam as all
parameters are; W_neq starts at 0, so that the agent starts equivariant. The final evaluation also
plays the actor with gamma = 0 (``success_truncated``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import torch
from torch import nn

from symsteer.agents.agent import Deterministic
from symsteer.agents.asymmetry import AsymmetricAgent, TwoPaths
from symsteer.agents.networks import Parameters, dense
from symsteer.agents.options import SacOptions
from symsteer.agents.presets import defaults_of
from symsteer.agents.replay import Batch
from symsteer.policies.networks.equivariant import EquivariantLayer


@dataclass(frozen=True)
class ConstrainedOptions(SacOptions):
    """Options of the constrained agent."""

    dual_lr: float = 1e-3
    """Rate eta of the ascent on the multipliers; 0: no constraint."""
    elastic: bool = False
    """Allow a slack u at the price u^2 / 2."""

    def __post_init__(self) -> None:
        super().__post_init__()
        self._require("not be negative", lambda value: value >= 0, "dual_lr")


class Constrained(TwoPaths):
    """The equivariant path plus gamma times the plain one; keeps the multiplier lambda."""

    def __init__(self, strict: EquivariantLayer):
        super().__init__(strict)
        self.gamma = nn.Parameter(torch.ones(()))
        # A parameter, because a team stacks parameters; the optimiser leaves it alone.
        self.multiplier = nn.Parameter(torch.zeros(()), requires_grad=False)

    def dense_of(self, parameters: Parameters) -> tuple[torch.Tensor, torch.Tensor]:
        weight, bias = self.strict_of(parameters)
        gamma = parameters["gamma"].unsqueeze(-1)
        bias = bias + gamma * parameters["free.bias"]
        return weight + gamma.unsqueeze(-1) * parameters["free.weight"], bias


@defaults_of("tuned")
class ConstrainedAgent(AsymmetricAgent):
    """The equivariant agent with a plain part in every layer, which dual ascent removes."""

    name = "constrained"
    in_teams = True
    Options = ConstrainedOptions
    options: ConstrainedOptions
    Layer = Constrained

    def penalty(self, name: str, batch: Batch) -> torch.Tensor | None:
        """The part of the Lagrangian that depends on gamma."""
        terms = []
        for _, layer in self.networks[name].layers():
            size = layer["gamma"].abs() if self.options.elastic else layer["gamma"]
            terms.append((layer["multiplier"].detach() * size).sum())
        return torch.stack(terms).sum()

    def settle(self, name: str) -> None:
        """One step of dual ascent."""
        for _, layer in self.networks[name].layers():
            gamma, multiplier = layer["gamma"], layer["multiplier"]
            if self.options.elastic:
                multiplier.add_(self.options.dual_lr * (gamma.abs() - multiplier)).clamp_(min=0)
            else:
                multiplier.add_(self.options.dual_lr * gamma)

    def alternatives(self) -> dict[str, Deterministic]:
        """The actor with gamma = 0, which is equivariant."""
        return {"truncated": self.act_truncated}

    @torch.no_grad()
    def act_truncated(self, obs: torch.Tensor) -> torch.Tensor:
        """Noise ``[B, Tp, Da]`` of the deterministic actor with gamma = 0."""
        layers = [cast(Constrained, layer) for layer, _ in self.actor.layers()]
        strict = [dense(layer.strict) for layer in layers]
        weights = [(weight[None], bias[None, None]) for weight, bias in strict]
        return self.chunk(self.distribution.squash(self._heads(weights, self._features(obs))[0]))
