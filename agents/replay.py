"""Replay buffer on the learner's device, with named fields."""

from __future__ import annotations

import math
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

    A transition is one row, so that a batch is one selection of rows.

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
        self.widths = [math.prod(shape) for shape in shapes.values()]
        self.rows = self._new_rows(0)
        self.position = 0
        self.size = 0
        # The size on the device: a CUDA graph reads it there.
        self.filled = torch.zeros((), dtype=torch.int64, device=self.device)
        self.generator = torch.Generator(device=self.device).manual_seed(seed)

    def __len__(self) -> int:
        return self.size

    @property
    def storage(self) -> dict[str, torch.Tensor]:
        """Each field of all rows, as views."""
        return self.batch_of(self.rows)

    def add(self, transition: Transition | Mapping[str, torch.Tensor]) -> None:
        """Append N transitions, at most the capacity; fields that the buffer lacks are ignored."""
        new = transition if isinstance(transition, Mapping) else vars(transition)
        count = len(new["reward"])
        self._grow(min(self.position + count, self.capacity))
        rows = (torch.arange(count, device=self.device) + self.position) % self.capacity
        fields = [new[name].to(self.rows).reshape(count, -1) for name in self.shapes]
        self.rows.index_copy_(0, rows, torch.cat(fields, 1))
        self.position = (self.position + count) % self.capacity
        self._resize(min(self.size + count, self.capacity))

    def sample(self, batch_size: int) -> Batch:
        """Draw ``batch_size`` transitions uniformly, with replacement.

        Raises:
            UserError: if the buffer is empty.
        """
        return self.batch_of(self.sample_rows(batch_size))

    def sample_rows(self, batch_size: int) -> torch.Tensor:
        """The same as rows ``[B, width]``, see :meth:`batch_of`."""
        if self.size == 0:
            raise UserError("the replay buffer is empty; collect transitions before updating")
        drawn = torch.randint(2**62, (batch_size,), generator=self.generator, device=self.device)
        return self.rows.index_select(0, drawn % self.filled)

    def batch_of(self, rows: torch.Tensor) -> Batch:
        """The fields of rows ``[..., width]``, as views."""
        fields = zip(self.shapes.items(), rows.split(self.widths, -1), strict=True)
        return Batch(
            {
                name: x.unflatten(-1, shape) if shape else x.squeeze(-1)
                for (name, shape), x in fields
            }
        )

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
        self._resize(size)
        self.position = position
        continue_stream(self.generator, state["generator"])

    def _resize(self, size: int) -> None:
        self.size = size
        self.filled.fill_(size)

    def _new_rows(self, count: int) -> torch.Tensor:
        return torch.zeros(count, sum(self.widths), dtype=self.dtype, device=self.device)

    def _grow(self, needed: int) -> None:
        """Allocate at least ``needed`` rows."""
        there = len(self.rows)
        if needed > there:
            more = min(self.capacity, max(needed, 2 * there, FIRST_ROWS)) - there
            self.rows = torch.cat([self.rows, self._new_rows(more)])
