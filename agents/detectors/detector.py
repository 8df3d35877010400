"""What detectors share: what they see of a decision, what they predict, how they compare.

A detector learns from a replay buffer what follows a decision: the change of the observation and
the reward. With the symmetry, what follows g s and g a is g times what follows s and a. A detector
gives a decision a score, which is large where it believes that this is not so. It sees no
simulation and no ground truth.
"""

from __future__ import annotations

import abc
from collections.abc import Callable
from typing import ClassVar

import torch

from symsteer.agents.agent import AgentContext
from symsteer.agents.networks import Ensemble
from symsteer.agents.optimization import adam, descend
from symsteer.agents.partial import block_weights
from symsteer.agents.replay import Batch
from symsteer.errors import UserError
from symsteer.policies.geometry import Field, Group, Layout

LEAST_DECISIONS = 200
WIDTH, DEPTH = 128, 2
STEPS, BATCH, LR = 3_000, 256, 1e-3
"""Of the training of all detectors that are networks."""


class Detector(abc.ABC):
    """Scores decisions by how much their symmetry seems to be broken.

    Args:
        context: layouts, execution length and scaling of observations.
        group: the symmetry that may be broken.
    """

    name: ClassVar[str]

    def __init__(self, context: AgentContext, group: Group):
        self.context, self.group = context, group
        executed = context.act_layout.repeat(context.execute)
        self.inputs = Layout.join(obs=context.obs_layout, actions=executed)
        self.outcomes = Layout([*context.obs_layout.fields, Field("reward", 0)])
        self.generator = torch.Generator().manual_seed(context.seed)
        self._blocks = self.outcomes.block_means
        self._weights = torch.ones(self._blocks.shape[1])

    def fit(self, replay: Batch) -> None:
        """Learn from decisions: ``obs``, ``actions``, ``next_obs`` and ``reward``.

        Raises:
            UserError: if there are too few.
        """
        if len(replay.reward) < LEAST_DECISIONS:
            raise UserError(
                f"a detector needs at least {LEAST_DECISIONS} decisions, not {len(replay.reward)}"
            )
        wanted = self.followed(replay)
        centred = wanted - wanted.mean(0) * self.outcomes.invariant_mask(self.group.reflections)
        sizes = centred.square().mean(0) @ self._blocks
        self._weights = block_weights(sizes)
        self.learn(replay)

    @abc.abstractmethod
    def learn(self, replay: Batch) -> None:
        """Learn from decisions."""

    @abc.abstractmethod
    def scores(self, obs: torch.Tensor, actions: torch.Tensor) -> dict[str, torch.Tensor]:
        """One or more scores of each decision, ``[B]``, by name.

        Args:
            obs: in environment units, ``[B, obs_dim]``.
            actions: executed, ``[B, Ta, Da]``.
        """

    # What a detector sees and predicts.

    def seen(self, obs: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """A decision as one vector of ``inputs``."""
        return torch.cat([self.context.normalize_obs(obs), actions.flatten(-2)], -1)

    def followed(self, replay: Batch) -> torch.Tensor:
        """What followed each decision, a vector of ``outcomes``."""
        before, after = (self.context.normalize_obs(x) for x in (replay.obs, replay.next_obs))
        return torch.cat([after - before, replay.reward.unsqueeze(-1)], -1)

    def distance(self, one: torch.Tensor, other: torch.Tensor) -> torch.Tensor:
        """Of outcomes: mean over irrep blocks of the squared difference, each in its own unit."""
        return ((one - other).square() @ self._blocks * self._weights).mean(-1)

    def orbit(
        self, inputs: torch.Tensor, predict: Callable[[torch.Tensor], torch.Tensor]
    ) -> torch.Tensor:
        """Predictions for all turned copies of decisions, turned back: ``[G, B, dim]``."""
        there = self.group.representation(self.inputs, inputs.dtype)
        back = self.group.representation(self.outcomes, inputs.dtype).mT
        return torch.stack(
            [predict(inputs @ g.mT) @ b.mT for g, b in zip(there, back, strict=True)]
        )

    def departure(self, orbit: torch.Tensor) -> torch.Tensor:
        """Distance ``[B]`` of a decision's own prediction from the medoid of its orbit's."""
        apart = self.distance(orbit.unsqueeze(0), orbit.unsqueeze(1))
        medoid = apart.sum(0).argmin(0)
        return apart[0].gather(0, medoid.unsqueeze(0)).squeeze(0)

    def train(
        self,
        networks: list[Ensemble],
        inputs: torch.Tensor,
        loss: Callable[[torch.Tensor], torch.Tensor],
    ) -> None:
        """Adam steps on batches.

        Args:
            networks: what is trained.
            inputs: of all decisions.
            loss: of a batch, given by its rows.
        """
        optimizer = adam([{"params": [p for n in networks for p in n.parameters()]}], LR)
        for _ in range(STEPS):
            rows = torch.randint(len(inputs), (BATCH,), generator=self.generator)
            descend(loss(rows), optimizer)
            for network in networks:
                network.changed()
