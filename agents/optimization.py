"""Adam steps on networks, and multipliers of constraints."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import torch

from symsteer.agents.generators import tensor_like


class Trained(Protocol):
    """What an optimiser trains.

    Attributes:
        vector: all its parameters.
    """

    vector: torch.Tensor

    def pieces(self, vector: torch.Tensor) -> list[torch.Tensor]:
        """A vector of the form of :attr:`vector` as tensors like :meth:`parameters`."""

    def parameters(self) -> Any:
        """The parameters one by one, in the order of a checkpoint."""


class Adam:
    """Adam (Kingma and Ba, arXiv 1412.6980) of one part of the learner.

    It changes one vector with one call. ``torch.optim.Adam`` calls the same function, after more
    work than the step itself. A checkpoint has the moments parameter by parameter.

    Attributes:
        moments: ``step``, and ``exp_avg`` and ``exp_avg_sq`` in the form of the vector.
    """

    def __init__(self, trained: Trained, lr: float):
        self.trained, self.lr = trained, lr
        vector = trained.vector.detach()
        self.moments = {
            "step": torch.zeros((), dtype=torch.float32, device=vector.device),
            "exp_avg": torch.zeros_like(vector),
            "exp_avg_sq": torch.zeros_like(vector),
        }

    def descend(self, loss: torch.Tensor, penalty: torch.Tensor | None = None) -> None:
        """One gradient step on a loss plus its regulariser; in a team on the sum over members."""
        vector = self.trained.vector
        if penalty is None:
            (gradient,) = torch.autograd.grad(loss.sum(), vector)
        else:
            # A regulariser may be a function of the parameters themselves.
            parameters = [p for p in self.trained.parameters() if p.requires_grad]
            total = loss.sum() + penalty.sum()
            gradient, *others = torch.autograd.grad(total, [vector, *parameters], allow_unused=True)
            given = dict(zip(parameters, others, strict=True))
            pieces = self.trained.pieces(gradient)
            for parameter, piece in zip(self.trained.parameters(), pieces, strict=True):
                if (other := given.get(parameter)) is not None:
                    piece.add_(other)
        self.step(gradient)

    @torch.no_grad()
    def step(self, gradient: torch.Tensor) -> None:
        """One step with a gradient in the form of the vector."""
        step, mean, square = self.moments.values()
        step.add_(1)
        vectors = (self.trained.vector, gradient, mean, square)
        vector, gradients, means, squares = (in_chunks(x) for x in vectors)
        torch._fused_adam_(
            vector,
            gradients,
            means,
            squares,
            [],
            [step] * len(vector),
            lr=self.lr,
            beta1=0.9,
            beta2=0.999,
            weight_decay=0.0,
            eps=1e-8,
            amsgrad=False,
            maximize=False,
        )

    def gather(self, members: Sequence[Adam]) -> None:
        """Take the state of the optimisers of a team's members."""
        self.moments["step"].copy_(members[0].moments["step"])
        for own, other in self._beside(members):
            own.copy_(other)

    def scatter(self, members: Sequence[Adam]) -> None:
        """Give it back."""
        for member in members:
            member.moments["step"].copy_(self.moments["step"])
        for own, other in self._beside(members):
            other.copy_(own)

    def _beside(self, members: Sequence[Adam]) -> list[tuple[torch.Tensor, torch.Tensor]]:
        """Each moment of each parameter, and the same in the optimisers of the members."""
        pairs = []
        for name in ("exp_avg", "exp_avg_sq"):
            own = self.trained.pieces(self.moments[name])
            others = [x for m in members for x in m.trained.pieces(m.moments[name])]
            pairs += list(zip(own, others, strict=True))
        return pairs

    def state_dict(self) -> dict[str, Any]:
        """The moments of each parameter."""
        moments = self.moments
        pieces = (self.trained.pieces(moments[name]) for name in ("exp_avg", "exp_avg_sq"))
        state = {
            index: {"step": moments["step"], "exp_avg": mean, "exp_avg_sq": square}
            for index, (mean, square) in enumerate(zip(*pieces, strict=True))
        }
        return {"state": state if moments["step"] else {}}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue with stored moments.

        Raises:
            ValueError: if they do not fit the parameters.
        """
        moments = self.moments
        for stored in state["state"].values():
            if stored.keys() != {"step", "exp_avg", "exp_avg_sq"} or not stored["step"] >= 1:
                raise ValueError("an optimiser has other moments")
            moments["step"].copy_(stored["step"])
        for name in ("exp_avg", "exp_avg_sq"):
            pieces = self.trained.pieces(moments[name])
            for index, stored in state["state"].items():
                pieces[index].copy_(tensor_like(stored[name], pieces[index]))


CHUNK, PARTS = 2048, 512
"""Least numbers in a part that a GPU's processor changes, and the largest number of parts."""


def in_chunks(x: torch.Tensor) -> list[torch.Tensor]:
    """A tensor for functions of lists; on a GPU in parts, of which each processor takes one."""
    if not x.is_cuda:
        return [x]
    return list(x.detach().reshape(-1).split(max(CHUNK, -(-x.numel() // PARTS))))


class Multiplier:
    """A positive number ``exp(log)`` that grows while the gap of its constraint is negative.

    Adam minimises its loss ``log * gap``. The gap of the temperature is the entropy minus its
    target (Haarnoja et al., arXiv 1812.05905, section 5). In a team there is one number for each
    member.
    """

    def __init__(self, log: torch.Tensor, lr: float):
        self.vector = log.requires_grad_()
        self.optimizer = Adam(self, lr)

    @classmethod
    def starting_at(
        cls, initial: float, lr: float, device: torch.device, dtype: torch.dtype
    ) -> Multiplier:
        """A single number."""
        return cls(torch.tensor(math.log(initial), dtype=dtype, device=device), lr)

    def pieces(self, vector: torch.Tensor) -> list[torch.Tensor]:
        """The numbers one by one."""
        return list(vector.view(-1).detach())

    def parameters(self) -> list[torch.Tensor]:
        """The numbers one by one."""
        return self.pieces(self.vector)

    @property
    def value(self) -> torch.Tensor:
        """The current value, without gradient."""
        return self.vector.detach().exp()

    def step(self, gap: torch.Tensor) -> torch.Tensor:
        """One gradient step with a gap without gradient; returns the loss."""
        loss = self.vector.detach() * gap
        self.optimizer.step(gap)
        return loss

    def state_dict(self) -> dict[str, Any]:
        """Value and optimiser."""
        return {"log": self.vector.detach(), "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.optimizer.load_state_dict(state["optimizer"])
        with torch.no_grad():
            self.vector.copy_(tensor_like(state["log"], self.vector))
