"""Contact impulses of N CPU scenes, in the shape of SAPIEN's GPU contact queries.

Impulses are those of the last substep, in newton seconds, summed over the contact points of a
pair. A pair's impulse acts on its first body; a body's impulse is what all others do to it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import sapien.physx as physx
import torch


class _Impulses:
    """Result of a query: float32 [n, 3], with the ``.torch()`` of SAPIEN's CudaArray."""

    def __init__(self, n: int) -> None:
        self.array = np.zeros((n, 3), dtype=np.float32)
        self._tensor = torch.from_numpy(self.array)

    def torch(self) -> torch.Tensor:
        return self._tensor


class PairImpulseQuery:
    """Asks for the impulse on the first body of each pair by the second one."""

    def __init__(self, body_pairs: Sequence[tuple[Any, Any]]) -> None:
        self.row = {pair: i for i, pair in enumerate(body_pairs)}
        self.cuda_impulses = _Impulses(len(body_pairs))


class BodyImpulseQuery:
    """Asks for the net contact impulse on each body."""

    def __init__(self, bodies: Sequence[Any]) -> None:
        self.row = {body: i for i, body in enumerate(bodies)}
        self.cuda_impulses = _Impulses(len(bodies))


class ContactReader:
    """Reads the contacts of every scene at most once a substep and answers all queries."""

    def __init__(self, systems: Sequence[physx.PhysxCpuSystem]) -> None:
        self._systems = systems
        self._pairs: list[tuple[Any, Any, np.ndarray]] | None = None

    def invalidate(self) -> None:
        """Forget what was read: the scenes have moved on."""
        self._pairs = None

    def _read(self) -> list[tuple[Any, Any, np.ndarray]]:
        if self._pairs is None:
            self._pairs = []
            for system in self._systems:
                for contact in system.get_contacts():
                    first, second = contact.bodies
                    impulse = np.sum([p.impulse for p in contact.points], axis=0, dtype=np.float64)
                    self._pairs.append((first, second, impulse))
        return self._pairs

    def read_pairs(self, query: PairImpulseQuery) -> None:
        out = np.zeros(query.cuda_impulses.array.shape)
        for first, second, impulse in self._read():
            if (row := query.row.get((first, second))) is not None:
                out[row] += impulse
            elif (row := query.row.get((second, first))) is not None:
                out[row] -= impulse
        query.cuda_impulses.array[:] = out

    def read_bodies(self, query: BodyImpulseQuery) -> None:
        out = np.zeros(query.cuda_impulses.array.shape)
        for first, second, impulse in self._read():
            if (row := query.row.get(first)) is not None:
                out[row] += impulse
            if (row := query.row.get(second)) is not None:
                out[row] -= impulse
        query.cuda_impulses.array[:] = out
