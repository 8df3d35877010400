"""Adam steps on networks, and multipliers of constraints."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch

from symsteer.agents.generators import tensor_like


class Multiplier:
    """A positive number ``exp(log)`` that grows while the gap of its constraint is negative.

    Adam minimises its loss ``log * gap``. The gap of the temperature is the entropy minus its
    target (Haarnoja et al., arXiv 1812.05905, section 5).
    """

    def __init__(self, initial: float, lr: float, device: torch.device, dtype: torch.dtype):
        self.log = torch.tensor(math.log(initial), dtype=dtype, device=device, requires_grad=True)
        self.optimizer = adam([{"params": [self.log]}], lr)

    @property
    def value(self) -> torch.Tensor:
        """The current value, without gradient."""
        return self.log.detach().exp()

    def step(self, gap: torch.Tensor) -> torch.Tensor:
        """One gradient step; returns the loss. In a team there is one number for each member."""
        loss = self.log * gap
        descend(loss, self.optimizer)
        return loss.detach()

    def state_dict(self) -> dict[str, Any]:
        """Value and optimiser."""
        return {"log": self.log.detach(), "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        restore_adam(self.optimizer, state["optimizer"])
        with torch.no_grad():
            self.log.copy_(tensor_like(state["log"], self.log))


def adam(groups: list[dict[str, Any]], lr: float) -> torch.optim.Adam:
    """The Adam of all parts of the learner."""
    return torch.optim.Adam(groups, lr=lr, fused=True)


def restore_adam(optimizer: torch.optim.Optimizer, state: Mapping[str, Any]) -> None:
    """Continue with stored moments; torch does not check that they fit the parameters."""
    own = optimizer.state_dict()["param_groups"]
    parameters = dict(enumerate(p for group in optimizer.param_groups for p in group["params"]))
    for index, moments in state["state"].items():
        for name in ("exp_avg", "exp_avg_sq"):
            tensor_like(moments[name], parameters[index])
        if moments.keys() != {"step", "exp_avg", "exp_avg_sq"} or not moments["step"].item() >= 1:
            raise ValueError("an optimiser has other moments")
    optimizer.load_state_dict({"state": state["state"], "param_groups": own})


def descend(
    loss: torch.Tensor, optimizer: torch.optim.Optimizer, penalty: torch.Tensor | None = None
) -> None:
    """One gradient step on a loss plus its regulariser; in a team on the sum over members."""
    optimizer.zero_grad()
    (loss.sum() if penalty is None else loss.sum() + penalty.sum()).backward()
    optimizer.step()
