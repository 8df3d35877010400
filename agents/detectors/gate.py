"""The gate of the partial agent (PE-SAC, arXiv 2512.00915), trained on a replay buffer alone."""

from __future__ import annotations

from typing import ClassVar

import torch

from symsteer.agents.agent import AgentContext
from symsteer.agents.detectors.detector import BATCH, DEPTH, LR, STEPS, WIDTH, Detector
from symsteer.agents.partial import PartialAgent, PartialOptions
from symsteer.agents.replay import Batch
from symsteer.policies.geometry import Group


class GateDetector(Detector):
    """Disagreement of an equivariant and a plain predictor, and the gate that learns from it."""

    name: ClassVar[str] = "gate"

    def __init__(self, context: AgentContext, group: Group):
        super().__init__(context, group)
        options = PartialOptions(
            critic="sampler",
            gate="soft",
            group=str(group),
            width=WIDTH,
            depth=DEPTH,
            lr=LR,
            reward_scale=1.0,
        )
        self.agent = PartialAgent(context, options)

    def learn(self, replay: Batch) -> None:
        """The agent's own training of predictors and gates."""
        for _ in range(STEPS):
            rows = torch.randint(len(replay.reward), (BATCH,), generator=self.generator)
            batch = Batch({name: replay[name][rows] for name in replay})
            batch["bank_actions"] = batch.actions.unsqueeze(1)
            self.agent.updates += 1
            self.agent.after_update(batch)

    @torch.no_grad()
    def scores(self, obs: torch.Tensor, actions: torch.Tensor) -> dict[str, torch.Tensor]:
        """``gate``: lambda(s, a); ``disagreement``: distance of the two predictions."""
        inputs = self.seen(obs, actions)
        strict, plain = (
            self.agent.own[name](inputs)[0] for name in ("strict_predictor", "plain_predictor")
        )
        return {
            "gate": self.agent.share(obs, actions),
            "disagreement": self.distance(strict, plain),
        }
