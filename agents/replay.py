"""Replay buffer on the learner's device, with named fields."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from symsteer.agents.generators import continue_stream
from symsteer.errors import UserError

FIRST_ROWS = 4096
"""Rows allocated at the start. When they are full, the buffer doubles, up to its capacity."""


@dataclass
class Transition:
    """One decision of N environments.

    ``terminal`` is true only if the episode ended with success. A time-out is not terminal: its
    target bootstraps from ``next_obs``. This is the last observation of the episode, not the first
    one after the reset.

    Attributes:
        obs: observation before the decision, ``[N, obs_dim]``.
        noise: chosen by the agent, ``[N, Tp, Da]``.
        actions: the executed action chunk, ``[N, Ta, Da]``.
        reward: summed over the executed steps, ``[N]``.
        next_obs: observation after the decision, ``[N, obs_dim]``.
        terminal: success, ``[N]`` bool.
        truncated: the time limit was reached without success, ``[N]`` bool.
    """

    obs: torch.Tensor
    noise: torch.Tensor
    actions: torch.Tensor
    reward: torch.Tensor
    next_obs: torch.Tensor
    terminal: torch.Tensor
    truncated: torch.Tensor


class Batch(dict[str, torch.Tensor]):
    """Transitions, one per row of each field; ``batch.obs`` is ``batch["obs"]``.

    Flags are 0 or 1 in the buffer's dtype.
    """

    def __getattr__(self, field: str) -> torch.Tensor:
        try:
            return self[field]
        except KeyError as error:
            raise AttributeError(
                f"the replay holds no {field!r}; it holds {', '.join(self)}"
            ) from error

    def replace(self, **changes: torch.Tensor) -> Batch:
        """A copy with some fields replaced."""
        return Batch({**self, **changes})


class ReplayBuffer:
    """A ring buffer of transitions with seeded uniform sampling.

    Args:
        capacity: number of transitions kept; the oldest is overwritten first.
        shapes: shape of each field in one transition, by field name of :class:`Transition`.
        device, dtype: of the stored tensors.
        seed: for drawing batches.

    Raises:
        UserError: if the capacity is not positive.
    """

    def __init__(
        self,
        capacity: int,
        shapes: Mapping[str, tuple[int, ...]],
        device: torch.device | str = "cpu",
        seed: int = 0,
        dtype: torch.dtype = torch.float32,
    ):
        if capacity < 1:
            raise UserError(f"the replay capacity must be at least 1, not {capacity}")
        self.capacity, self.device, self.dtype = capacity, torch.device(device), dtype
        self.shapes = dict(shapes)
        self.storage = {name: self._rows(name, 0) for name in shapes}
        self.position = 0
        self.size = 0
        self.generator = torch.Generator(device=self.device).manual_seed(seed)

    def __len__(self) -> int:
        return self.size

    def add(self, transition: Transition | Mapping[str, torch.Tensor]) -> None:
        """Append N transitions, at most the capacity; fields that the buffer lacks are ignored."""
        new = transition if isinstance(transition, Mapping) else vars(transition)
        count = len(new["reward"])
        self._grow(min(self.position + count, self.capacity))
        rows = (torch.arange(count, device=self.device) + self.position) % self.capacity
        for name, kept in self.storage.items():
            kept.index_copy_(0, rows, new[name].to(kept))
        self.position = (self.position + count) % self.capacity
        self.size = min(self.size + count, self.capacity)

    def sample(self, batch_size: int, gamma: float) -> Batch:
        """Draw ``batch_size`` transitions uniformly, with replacement.

        Returns:
            The fields, and ``discount [B]``: ``gamma``, per decision.

        Raises:
            UserError: if the buffer is empty.
        """
        if self.size == 0:
            raise UserError("the replay buffer is empty; collect transitions before updating")
        rows = torch.randint(self.size, (batch_size,), generator=self.generator, device=self.device)
        batch = Batch({name: kept.index_select(0, rows) for name, kept in self.storage.items()})
        batch["discount"] = torch.full_like(batch.reward, gamma)
        return batch

    def state_dict(self) -> dict[str, Any]:
        """The filled rows, the position and the generator."""
        return {
            "rows": {name: kept[: self.size].clone() for name, kept in self.storage.items()},
            "position": self.position,
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned.

        Raises:
            UserError: if the saved transitions have other fields or shapes, or do not fit.
        """
        rows, position = state["rows"], state["position"]
        sizes = {len(kept) for kept in rows.values()}
        shapes = {name: tuple(kept.shape[1:]) for name, kept in rows.items()}
        size = max(sizes, default=0)
        # Until the ring is full, its next row is the first free one.
        free = range(self.capacity) if size == self.capacity else range(size, self.capacity)[:1]
        if shapes != self.shapes or len(sizes) != 1 or position not in free:
            raise UserError(
                f"the saved replay holds {size} transitions of {shapes}, this buffer up to "
                f"{self.capacity} of {self.shapes}; resume with the run's own configuration"
            )
        self._grow(size)
        for name, kept in self.storage.items():
            kept[:size] = rows[name].to(kept)
        self.size, self.position = size, position
        continue_stream(self.generator, state["generator"])

    def _rows(self, name: str, count: int) -> torch.Tensor:
        return torch.zeros(count, *self.shapes[name], dtype=self.dtype, device=self.device)

    def _grow(self, needed: int) -> None:
        """Allocate at least ``needed`` rows."""
        there = len(next(iter(self.storage.values())))
        if needed > there:
            more = min(self.capacity, max(needed, 2 * there, FIRST_ROWS)) - there
            self.storage = {
                name: torch.cat([kept, self._rows(name, more)])
                for name, kept in self.storage.items()
            }
