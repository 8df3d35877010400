"""Adam steps on networks, and multipliers of constraints."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

import torch

from symsteer.agents.generators import tensor_like


class Adam(torch.optim.Adam):
    """The Adam of all parts of the learner."""

    def __init__(self, parameters: Iterable[torch.Tensor], lr: float):
        super().__init__(parameters, lr=lr, fused=True)

    def descend(self, loss: torch.Tensor, penalty: torch.Tensor | None = None) -> None:
        """One gradient step on a loss plus its regulariser; in a team on the sum over members."""
        self.zero_grad()
        (loss.sum() if penalty is None else loss.sum() + penalty.sum()).backward()
        self.step()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue with stored moments; torch does not check that they fit the parameters."""
        groups = self.state_dict()["param_groups"]
        parameters = dict(enumerate(p for group in self.param_groups for p in group["params"]))
        for index, moments in state["state"].items():
            for name in ("exp_avg", "exp_avg_sq"):
                tensor_like(moments[name], parameters[index])
            if moments.keys() != {"step", "exp_avg", "exp_avg_sq"} or not moments["step"] >= 1:
                raise ValueError("an optimiser has other moments")
        super().load_state_dict({"state": state["state"], "param_groups": groups})


class Multiplier:
    """A positive number ``exp(log)`` that grows while the gap of its constraint is negative.

    Adam minimises its loss ``log * gap``. The gap of the temperature is the entropy minus its
    target (Haarnoja et al., arXiv 1812.05905, section 5).
    """

    def __init__(self, initial: float, lr: float, device: torch.device, dtype: torch.dtype):
        self.log = torch.tensor(math.log(initial), dtype=dtype, device=device, requires_grad=True)
        self.optimizer = Adam([self.log], lr)

    @property
    def value(self) -> torch.Tensor:
        """The current value, without gradient."""
        return self.log.detach().exp()

    def step(self, gap: torch.Tensor) -> torch.Tensor:
        """One gradient step; returns the loss. In a team there is one number for each member."""
        loss = self.log * gap
        self.optimizer.descend(loss)
        return loss.detach()

    def state_dict(self) -> dict[str, Any]:
        """Value and optimiser."""
        return {"log": self.log.detach(), "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.optimizer.load_state_dict(state["optimizer"])
        with torch.no_grad():
            self.log.copy_(tensor_like(state["log"], self.log))
