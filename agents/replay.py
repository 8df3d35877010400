"""Replay buffer on the learner's device, with named fields."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from symsteer.agents.generators import continue_stream
from symsteer.errors import UserError

FOLLOWED = ("reward", "next_obs", "terminal", "truncated")

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
        self.stride = 1  # rows between successive decisions of one environment
        self.generator = torch.Generator(device=self.device).manual_seed(seed)

    def __len__(self) -> int:
        return self.size

    def add(self, transition: Transition | Mapping[str, torch.Tensor]) -> None:
        """Append N transitions; other fields than those of the buffer are ignored.

        Raises:
            UserError: if N exceeds the capacity.
        """
        new = transition if isinstance(transition, Mapping) else vars(transition)
        count = len(new["reward"])
        if count > self.capacity:
            raise UserError(
                f"{count} transitions at once do not fit a replay buffer of {self.capacity}; "
                "raise replay_capacity"
            )
        self._grow(min(self.position + count, self.capacity))
        rows = (torch.arange(count, device=self.device) + self.position) % self.capacity
        for name, kept in self.storage.items():
            kept.index_copy_(0, rows, new[name].to(kept))
        self.position = (self.position + count) % self.capacity
        self.stride = count
        self.size = min(self.size + count, self.capacity)

    def sample(self, batch_size: int, gamma: float, n_step: int = 1) -> Batch:
        """Draw ``batch_size`` transitions uniformly, with replacement.

        With ``n_step`` above 1, a transition is joined with those that follow it in its episode, up
        to this number: ``reward`` is their discounted sum; ``next_obs``, ``terminal`` and
        ``truncated`` are those of the last one.

        Args:
            batch_size: number of rows.
            gamma: discount per decision.
            n_step: decisions in a row.

        Returns:
            The fields, and ``discount [B]``: gamma to the power of the decisions that were joined.

        Raises:
            UserError: if the buffer is empty.
        """
        if self.size == 0:
            raise UserError("the replay buffer is empty; collect transitions before updating")
        rows = torch.randint(self.size, (batch_size,), generator=self.generator, device=self.device)
        batch = Batch({name: kept.index_select(0, rows) for name, kept in self.storage.items()})
        batch["discount"] = torch.full_like(batch.reward, gamma)
        for _ in range(n_step - 1):
            following = (rows + self.stride) % self.capacity
            following = following.clamp(max=self.size - 1)
            then = {name: self.storage[name][following] for name in FOLLOWED}
            # A row continues another one if it is newer and starts where that one ended. This is
            # never so across resets, fresh scenes, or the place where the ring is overwritten.
            joined = (self.storage["obs"][following] == batch.next_obs).all(1)
            joined &= (self.position - 1 - rows) % self.capacity >= self.stride
            joined &= (batch.terminal + batch.truncated) == 0
            batch["reward"] = batch.reward + joined * batch.discount * then["reward"]
            batch["discount"] = torch.where(joined, gamma * batch.discount, batch.discount)
            for name in ("next_obs", "terminal", "truncated"):
                old = batch[name]
                batch[name] = torch.where(joined.view(-1, *[1] * (old.ndim - 1)), then[name], old)
            rows = torch.where(joined, following, rows)
        return batch

    def in_order(self) -> dict[str, torch.Tensor]:
        """All whole steps, oldest first; each has one row for each environment."""
        count = self.size - self.size % self.stride
        rows = torch.arange(self.position - count, self.position, device=self.device)
        return {name: kept[rows % self.capacity] for name, kept in self.storage.items()}

    def state_dict(self) -> dict[str, Any]:
        """The filled rows, the position, the stride and the generator."""
        return {
            "rows": {name: kept[: self.size].clone() for name, kept in self.storage.items()},
            "position": self.position,
            "stride": self.stride,
            "generator": self.generator.get_state(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restore what :meth:`state_dict` returned.

        Raises:
            UserError: if the saved transitions have other fields or shapes, or do not fit.
        """
        rows, position, stride = state["rows"], state["position"], state["stride"]
        sizes = {len(kept) for kept in rows.values()}
        found = {name: tuple(kept.shape[1:]) for name, kept in rows.items()}
        size = max(sizes, default=0)
        # Until the ring is full, its next row is the first free one.
        free = range(self.capacity) if size == self.capacity else range(size, self.capacity)[:1]
        told = position in free and stride in range(1, max(size, 1) + 1)
        if found != self.shapes or len(sizes) != 1 or not told:
            raise UserError(
                f"the saved replay holds {size} transitions of {found}, this buffer up to "
                f"{self.capacity} of {self.shapes}; resume with the run's own configuration"
            )
        self._grow(size)
        for name, kept in self.storage.items():
            kept[:size] = rows[name].to(kept)
        self.size, self.position, self.stride = size, position, stride
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
