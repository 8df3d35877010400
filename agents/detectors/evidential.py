"""Deep evidential regression (Amini et al., arXiv 1910.02600) about an equivariant mean.

A normal-inverse-gamma distribution (NIG) of what follows: the mean is equivariant, the evidence is
plain. Where the symmetry is broken, an equivariant mean is wrong, and the evidence must say so.
Our choices: the equivariant mean (the paper knows no group), and one variance for each irrep block.
"""

from __future__ import annotations

import math
from typing import ClassVar

import torch
import torch.nn.functional as F

from symsteer.agents.agent import AgentContext
from symsteer.agents.detectors.detector import DEPTH, WIDTH, Detector
from symsteer.agents.equivariant import equivariant_layers
from symsteer.agents.networks import Ensemble
from symsteer.agents.options import SacOptions
from symsteer.agents.replay import Batch
from symsteer.agents.standard import plain_layers
from symsteer.policies.geometry import Group

REGULARIZER = 0.01
"""Weight of the evidence of wrong predictions (lambda in the paper's equation 10)."""


class EvidentialDetector(Detector):
    """Variance of what follows about the best equivariant prediction."""

    name: ClassVar[str] = "evidential"

    def __init__(self, context: AgentContext, group: Group):
        super().__init__(context, group)
        options = SacOptions(group=str(group), width=WIDTH, depth=DEPTH)
        blocks = len(self.outcomes.blocks)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(context.seed)
            mean = equivariant_layers(self.inputs, self.outcomes, options)
            evidence = plain_layers(self.inputs.dim, WIDTH, DEPTH, 3 * blocks)
        self.mean, self.evidence = (Ensemble([x], layer_norm=True) for x in (mean, evidence))

    def learn(self, replay: Batch) -> None:
        """Minimise the paper's loss."""
        inputs = self.seen(replay.obs, replay.actions)
        wanted = self.followed(replay) * self._weights.sqrt()[self.outcomes.block_index]

        def loss(rows: torch.Tensor) -> torch.Tensor:
            error = self.mean(inputs[rows])[0] - wanted[rows]
            return nig_loss(error, *self._parameters(inputs[rows])).mean()

        self.train([self.mean, self.evidence], inputs, loss)

    @torch.no_grad()
    def scores(self, obs: torch.Tensor, actions: torch.Tensor) -> dict[str, torch.Tensor]:
        """``evidential``: mean over blocks of the expected variance, beta / (alpha - 1)."""
        _, alpha, beta = self._parameters(self.seen(obs, actions))
        return {"evidential": (beta / (alpha - 1)) @ self._blocks.mean(1)}

    def _parameters(self, inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """nu, alpha and beta for each number of an outcome, ``[B, dim]``."""
        raw = self.evidence(inputs)[0][..., self._index].unflatten(-1, (3, -1))
        nu, alpha, beta = (F.softplus(raw) + 1e-6).unbind(-2)
        return nu, 1 + alpha, beta

    @property
    def _index(self) -> torch.Tensor:
        blocks, index = len(self.outcomes.blocks), self.outcomes.block_index
        return torch.cat([index + k * blocks for k in range(3)])


def nig_loss(
    error: torch.Tensor, nu: torch.Tensor, alpha: torch.Tensor, beta: torch.Tensor
) -> torch.Tensor:
    """Negative log evidence and its regulariser (equations 8 to 10), of the shape of ``error``."""
    omega = 2 * beta * (1 + nu)
    likelihood = (
        0.5 * (math.pi / nu).log()
        - alpha * omega.log()
        + (alpha + 0.5) * (error.square() * nu + omega).log()
        + alpha.lgamma()
        - (alpha + 0.5).lgamma()
    )
    return likelihood + REGULARIZER * error.abs() * (2 * nu + alpha)
