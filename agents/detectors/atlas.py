"""Local predictors, and the group elements that they respect, after AtlasD (arXiv 2504.10777).

The paper trains a predictor for each chart of an atlas and searches for transformations under which
the predictors are equivariant. Here the transformations are known; the search is for those that
hold in a chart. Our choices: charts are clusters of observations, predictors are affine, and an
element takes a chart to wherever it takes its decisions.
"""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import torch
from scipy.cluster.vq import kmeans2

from symsteer.agents.detectors.detector import Detector
from symsteer.agents.replay import Batch

CHARTS = 24
PER_CHART = 4
"""Decisions of a chart for each number that its predictor sees, at least, on average."""
RIDGE = 1e-2
TOLERANCE = 0.05
"""An element is respected if it adds less than this to the error of prediction, in units of
:meth:`Detector.distance`."""


class AtlasDetector(Detector):
    """How much worse decisions of a chart are predicted from where the group takes them."""

    name: ClassVar[str] = "atlas"

    def learn(self, replay: Batch) -> None:
        """Charts, a ridge regression in each of them, and the elements that it respects."""
        inputs, wanted = self.seen(replay.obs, replay.actions), self.followed(replay)
        places = inputs[:, : self.context.obs_layout.dim].double().numpy()
        most = max(1, min(CHARTS, len(inputs) // (PER_CHART * inputs.shape[1])))
        centres, labels = kmeans2(
            places, most, minit="++", seed=np.random.default_rng(self.context.seed)
        )
        used, labels = np.unique(labels, return_inverse=True)
        self._centres = torch.as_tensor(centres[used]).float()
        chart = torch.as_tensor(labels)
        weights, left_out = [], torch.zeros_like(wanted)
        for index in range(len(used)):
            own = chart == index
            x, y = _affine(inputs[own]).double(), wanted[own].double()
            gram = x.mT @ x + RIDGE * len(x) * torch.eye(x.shape[1])
            solved = torch.linalg.solve(gram, x.mT)
            weights.append((solved @ y).float())
            # Predictions of a regression without the decision itself.
            influence = (x * solved.mT).sum(1, keepdim=True).clamp(max=0.99)
            residual = (y - x @ solved @ y) / (1 - influence)
            left_out[own] = (y - residual).float()
        self._coefficients = torch.stack(weights)
        added = self.distance(self.orbit(inputs, self._predict), wanted)
        added = added - self.distance(left_out, wanted)
        self.excess = torch.stack([added[:, chart == i].mean(1) for i in range(len(used))])
        """What every element adds to the error of prediction, by chart: ``[charts, G]``."""

    @property
    def respected(self) -> torch.Tensor:
        """Which elements each chart respects, ``[charts, G]`` bool."""
        return self.excess < TOLERANCE

    def scores(self, obs: torch.Tensor, actions: torch.Tensor) -> dict[str, torch.Tensor]:
        """``atlas``: what the elements add to the error in the decision's chart, mean over them."""
        return {"atlas": self.excess[self._chart(self.seen(obs, actions))][:, 1:].mean(1)}

    def _chart(self, inputs: torch.Tensor) -> torch.Tensor:
        return torch.cdist(inputs[:, : self._centres.shape[1]], self._centres).argmin(1)

    def _predict(self, inputs: torch.Tensor) -> torch.Tensor:
        found = torch.zeros(len(inputs), self.outcomes.dim)
        chart = self._chart(inputs)
        for index in chart.unique().tolist():
            found[chart == index] = _affine(inputs[chart == index]) @ self._coefficients[index]
        return found


def _affine(inputs: torch.Tensor) -> torch.Tensor:
    return torch.cat([inputs, torch.ones(len(inputs), 1, dtype=inputs.dtype)], -1)
