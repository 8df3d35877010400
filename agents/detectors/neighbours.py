"""Nearest decisions: compares what followed here with what followed in turned places.

The simplest detector, without a network: what the others must beat.
"""

from __future__ import annotations

from typing import ClassVar

import torch
from scipy.spatial import KDTree

from symsteer.agents.detectors.detector import Detector
from symsteer.agents.replay import Batch

COUNT = 8


class Neighbours(Detector):
    """Mean outcome of the nearest decisions, compared over the orbit."""

    name: ClassVar[str] = "neighbours"

    def learn(self, replay: Batch) -> None:
        """Keep all decisions in a tree."""
        self._tree = KDTree(self.seen(replay.obs, replay.actions).numpy())
        self._followed = self.followed(replay)

    def scores(self, obs: torch.Tensor, actions: torch.Tensor) -> dict[str, torch.Tensor]:
        """``neighbours``: departure from the majority of the orbit."""
        orbit = self.orbit(self.seen(obs, actions), self._predict)
        return {"neighbours": self.departure(orbit)}

    def _predict(self, inputs: torch.Tensor) -> torch.Tensor:
        _, rows = self._tree.query(inputs.numpy(), COUNT)
        return self._followed[torch.as_tensor(rows)].mean(1)
