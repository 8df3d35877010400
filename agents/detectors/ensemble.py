"""An ensemble of plain predictors: its disagreement over the group, and among its members."""

from __future__ import annotations

from typing import ClassVar

import torch

from symsteer.agents.agent import AgentContext
from symsteer.agents.detectors.detector import DEPTH, WIDTH, Detector
from symsteer.agents.networks import Ensemble
from symsteer.agents.replay import Batch
from symsteer.agents.standard import plain_layers
from symsteer.policies.geometry import Group

MEMBERS = 5


class EnsembleDetector(Detector):
    """Plain networks that predict what follows, with different initial weights."""

    name: ClassVar[str] = "ensemble"

    def __init__(self, context: AgentContext, group: Group):
        super().__init__(context, group)
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(context.seed)
            layers = [
                plain_layers(self.inputs.dim, WIDTH, DEPTH, self.outcomes.dim)
                for _ in range(MEMBERS)
            ]
        self.network = Ensemble(layers, layer_norm=True)

    def learn(self, replay: Batch) -> None:
        """Regression of all members on the same batches."""
        inputs, wanted = self.seen(replay.obs, replay.actions), self.followed(replay)
        self.train(
            [self.network],
            inputs,
            lambda rows: self.distance(self.network(inputs[rows]), wanted[rows]).mean(),
        )

    @torch.no_grad()
    def scores(self, obs: torch.Tensor, actions: torch.Tensor) -> dict[str, torch.Tensor]:
        """``orbit``: departure of the mean prediction from the majority of the orbit's.

        Two controls know nothing of the group: ``members``, spread of the members, and ``change``,
        size of what is predicted: where nothing moves, no symmetry is broken.
        """
        inputs = self.seen(obs, actions)
        each = self.network(inputs)
        mean = each.mean(0)
        return {
            "orbit": self.departure(self.orbit(inputs, lambda x: self.network(x).mean(0))),
            "members": self.distance(each, mean).mean(0),
            "change": self.distance(mean, mean * 0),
        }
