"""Adam steps on networks, and multipliers of constraints."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from typing import Any, Protocol

import torch

from symsteer.agents.generators import tensor_like


class Trained(Protocol):
    """What an optimiser trains.

    Attributes:
        tensors: all its parameters.
    """

    @property
    def tensors(self) -> list[torch.Tensor]: ...

    def pieces(self, tensors: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """Tensors of the form of :attr:`tensors` as ones like :meth:`parameters`."""

    def parameters(self) -> Any:
        """The parameters one by one, in the order of a checkpoint."""


class Adam:
    """Adam (Kingma and Ba, arXiv 1412.6980) of one part of the learner.

    It changes all tensors with one call. ``torch.optim.Adam`` calls the same function, after more
    work than the step itself. A checkpoint has the moments parameter by parameter.

    Attributes:
        steps: their number, on the device.
        moments: ``exp_avg`` and ``exp_avg_sq``, in the form of what is trained.
    """

    def __init__(self, trained: Trained, lr: float):
        self.trained, self.lr = trained, lr
        self.steps = torch.zeros((), dtype=torch.float32, device=trained.tensors[0].device)
        self.moments = {
            name: [torch.zeros_like(tensor) for tensor in trained.tensors]
            for name in ("exp_avg", "exp_avg_sq")
        }

    def descend(self, loss: torch.Tensor, penalty: torch.Tensor | None = None) -> None:
        """One gradient step on a loss plus its regulariser; in a team on the sum over members."""
        trained, parameters = self.trained, []
        total = loss.sum()
        if penalty is not None:
            # A regulariser may be a function of the parameters themselves.
            parameters = [p for p in trained.parameters() if p.requires_grad]
            total = total + penalty.sum()
        wanted = [*trained.tensors, *parameters]
        found = torch.autograd.grad(total, wanted, allow_unused=True)
        gradients = [
            torch.zeros_like(tensor) if gradient is None else gradient
            for tensor, gradient in zip(trained.tensors, found, strict=False)
        ]
        others = dict(zip(parameters, found[len(gradients) :], strict=True))
        with torch.no_grad():
            if any(other is not None for other in others.values()):
                gradients = [gradient.clone() for gradient in gradients]
                for parameter, piece in zip(
                    trained.parameters(), trained.pieces(gradients), strict=True
                ):
                    if (other := others.get(parameter)) is not None:
                        piece.add_(other)
            self.step(gradients)

    def step(self, gradients: Sequence[torch.Tensor]) -> None:
        """One step with gradients in the form of what is trained; called without gradients."""
        self.steps.add_(1)
        # The function reads memory in order, whatever the strides are.
        gradients = [gradient.contiguous() for gradient in gradients]
        changed = (self.trained.tensors, gradients, *self.moments.values())
        parts, gradients, means, squares = (in_chunks(tensors) for tensors in changed)
        torch._fused_adam_(
            parts,
            gradients,
            means,
            squares,
            [],
            [self.steps] * len(parts),
            lr=self.lr,
            beta1=0.9,
            beta2=0.999,
            weight_decay=0.0,
            eps=1e-8,
            amsgrad=False,
            maximize=False,
        )

    def tensors(self) -> list[torch.Tensor]:
        """All that a step changes."""
        return [self.steps, *self.trained.tensors, *itertools.chain(*self.moments.values())]

    def gather(self, members: Sequence[Adam]) -> None:
        """Take the state of the optimisers of a team's members."""
        self.steps.copy_(members[0].steps)
        for own, other in self._beside(members):
            own.copy_(other)

    def scatter(self, members: Sequence[Adam]) -> None:
        """Give it back."""
        for member in members:
            member.steps.copy_(self.steps)
        for own, other in self._beside(members):
            other.copy_(own)

    def _beside(self, members: Sequence[Adam]) -> list[tuple[torch.Tensor, torch.Tensor]]:
        """Each moment of each parameter, and the same in the optimisers of the members."""
        pairs = []
        for name, moments in self.moments.items():
            own = self.trained.pieces(moments)
            others = [x for m in members for x in m.trained.pieces(m.moments[name])]
            pairs += list(zip(own, others, strict=True))
        return pairs

    def state_dict(self) -> dict[str, Any]:
        """The moments of each parameter."""
        pieces = (self.trained.pieces(moments) for moments in self.moments.values())
        state = {
            index: {"step": self.steps, **dict(zip(self.moments, each, strict=True))}
            for index, each in enumerate(zip(*pieces, strict=True))
        }
        return {"state": state if self.steps else {}}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue with stored moments.

        Raises:
            ValueError: if they do not fit the parameters.
        """
        for stored in state["state"].values():
            if stored.keys() != {"step", *self.moments} or not stored["step"] >= 1:
                raise ValueError("an optimiser has other moments")
            self.steps.copy_(stored["step"])
        for name, moments in self.moments.items():
            pieces = self.trained.pieces(moments)
            for index, stored in state["state"].items():
                pieces[index].copy_(tensor_like(stored[name], pieces[index]))


CHUNK, PARTS = 2048, 512
"""Least numbers in a part that a GPU's processor changes, and the largest number of parts."""


def in_chunks(tensors: Sequence[torch.Tensor]) -> list[torch.Tensor]:
    """Tensors for functions of lists; on a GPU in parts, of which each processor takes one."""
    if not tensors[0].is_cuda:
        return list(tensors)
    size = max(CHUNK, -(-sum(x.numel() for x in tensors) // PARTS))
    return [part for x in tensors for part in x.detach().reshape(-1).split(size)]


class Multiplier:
    """A positive number ``exp(log)`` that grows while the gap of its constraint is negative.

    Adam minimises its loss ``log * gap``. The gap of the temperature is the entropy minus its
    target (Haarnoja et al., arXiv 1812.05905, section 5). In a team there is one number for each
    member.
    """

    def __init__(self, log: torch.Tensor, lr: float):
        self.log = log
        self.optimizer = Adam(self, lr)

    @classmethod
    def starting_at(
        cls, initial: float, lr: float, device: torch.device, dtype: torch.dtype
    ) -> Multiplier:
        """A single number."""
        return cls(torch.tensor(math.log(initial), dtype=dtype, device=device), lr)

    @property
    def tensors(self) -> list[torch.Tensor]:
        """The numbers, as the optimiser changes them."""
        return [self.log]

    def pieces(self, tensors: Sequence[torch.Tensor]) -> list[torch.Tensor]:
        """The numbers one by one."""
        return list(tensors[0].view(-1))

    def parameters(self) -> list[torch.Tensor]:
        """The numbers one by one."""
        return self.pieces(self.tensors)

    @property
    def value(self) -> torch.Tensor:
        """The current value."""
        return self.log.exp()

    def step(self, gap: torch.Tensor) -> torch.Tensor:
        """One gradient step with a gap without gradient; returns the loss."""
        loss = self.log * gap
        self.optimizer.step([gap])
        return loss

    def state_dict(self) -> dict[str, Any]:
        """Value and optimiser."""
        return {"log": self.log, "optimizer": self.optimizer.state_dict()}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned."""
        self.optimizer.load_state_dict(state["optimizer"])
        with torch.no_grad():
            self.log.copy_(tensor_like(state["log"], self.log))
