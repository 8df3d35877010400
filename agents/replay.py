"""Transitions in preallocated tensors on the learner's device."""

from __future__ import annotations

from typing import NamedTuple

import torch

from symsteer.errors import UserError


class Batch(NamedTuple):
    """Transitions of the latent-noise environment, one per row.

    ``terminal`` is 1 only where the episode ended by success. A time-out is not terminal: its
    target bootstraps from ``next_obs``, which must be the true last observation of the episode,
    not the first one after the reset.
    """

    obs: torch.Tensor  # [B, obs_dim]
    noise: torch.Tensor  # [B, Tp, Da]
    reward: torch.Tensor  # [B], summed over the executed steps of the chunk
    next_obs: torch.Tensor  # [B, obs_dim]
    terminal: torch.Tensor  # [B], 0 or 1


class ReplayBuffer:
    """A ring of transitions with seeded uniform sampling.

    Args:
        capacity: number of transitions kept; the oldest is overwritten first.
        obs_dim, horizon, act_dim: shapes of one transition.
        device, dtype: where and how the numbers are kept.
        seed: of the generator that draws batches.

    Raises:
        UserError: if the capacity is not positive.
    """

    def __init__(
        self,
        capacity: int,
        obs_dim: int,
        horizon: int,
        act_dim: int,
        device: torch.device | str = "cpu",
        seed: int = 0,
        dtype: torch.dtype = torch.float32,
    ):
        if capacity < 1:
            raise UserError(f"the replay capacity must be at least 1, not {capacity}")

        def empty(*shape: int) -> torch.Tensor:
            return torch.zeros(capacity, *shape, dtype=dtype, device=device)

        self.capacity, self.device = capacity, torch.device(device)
        self.storage = Batch(
            empty(obs_dim), empty(horizon, act_dim), empty(), empty(obs_dim), empty()
        )
        self.position = 0
        self.size = 0
        self.generator = torch.Generator(device=self.device).manual_seed(seed)

    def __len__(self) -> int:
        return self.size

    def add(
        self,
        obs: torch.Tensor,
        noise: torch.Tensor,
        reward: torch.Tensor,
        next_obs: torch.Tensor,
        terminal: torch.Tensor,
    ) -> None:
        """Append N transitions (shapes as in :class:`Batch`).

        Raises:
            UserError: if N exceeds the capacity.
        """
        count = len(obs)
        if count > self.capacity:
            raise UserError(
                f"{count} transitions at once do not fit a replay buffer of {self.capacity}; "
                "raise replay_capacity"
            )
        rows = (torch.arange(count, device=self.device) + self.position) % self.capacity
        for kept, new in zip(self.storage, (obs, noise, reward, next_obs, terminal), strict=True):
            kept.index_copy_(0, rows, new.to(kept))
        self.position = (self.position + count) % self.capacity
        self.size = min(self.size + count, self.capacity)

    def sample(self, batch_size: int) -> Batch:
        """Draw ``batch_size`` transitions uniformly, with replacement.

        Raises:
            UserError: if the buffer is empty.
        """
        if self.size == 0:
            raise UserError("the replay buffer is empty; collect transitions before updating")
        rows = torch.randint(self.size, (batch_size,), generator=self.generator, device=self.device)
        return Batch(*(kept.index_select(0, rows) for kept in self.storage))

    def state_dict(self) -> dict[str, torch.Tensor]:
        """The filled rows, the position and the generator; tensors only."""
        state = {name: kept[: self.size].clone() for name, kept in self.storage._asdict().items()}
        state["position"] = torch.tensor(self.position)
        state["generator"] = self.generator.get_state()
        return state

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Restore what :meth:`state_dict` returned.

        Raises:
            UserError: if the saved transitions have other shapes or do not fit.
        """
        for name, kept in self.storage._asdict().items():
            saved = state[name]
            if saved.shape[1:] != kept.shape[1:] or len(saved) > self.capacity:
                raise UserError(
                    f"the saved replay holds {name} of shape {tuple(saved.shape)}, this buffer "
                    f"{tuple(kept.shape)}; resume with the run's own configuration"
                )
            kept[: len(saved)] = saved.to(kept)
        self.size = len(state["obs"])
        self.position = int(state["position"])
        self.generator.set_state(state["generator"].cpu())
