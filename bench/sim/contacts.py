"""Contact impulses of N CPU scenes, in the shape of SAPIEN's GPU contact queries.

Impulses are those of the last substep, in newton seconds, summed over the contact points of a
pair. A pair's impulse acts on its first body; a body's impulse is what all others do to it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any, TypeVar

import numpy as np
import sapien.physx as physx
import torch

# Row and sign with which a contact's impulse enters a result.
_Entries = list[tuple[int, int]]


class Impulses:
    """Result of a query: float32 [n, 3], with the ``.torch()`` of SAPIEN's CudaArray."""

    def __init__(self, n: int) -> None:
        self.array = np.zeros((n, 3), dtype=np.float32)
        self._tensor = torch.from_numpy(self.array)

    def torch(self) -> torch.Tensor:
        """The impulses as a tensor; shares memory with the array."""
        return self._tensor


class PairImpulseQuery:
    """Asks for the impulse on the first body of each pair by the second one."""

    def __init__(self, body_pairs: Sequence[tuple[Any, Any]]) -> None:
        self.cuda_impulses = Impulses(len(body_pairs))
        self._entries: dict[tuple[Any, Any], _Entries] = defaultdict(list)
        for row, (first, second) in enumerate(body_pairs):
            self._entries[first, second].append((row, 1))
            self._entries[second, first].append((row, -1))

    def entries(self, first: Any, second: Any) -> _Entries:
        """Rows and signs for a contact between two bodies; empty when it is none of ours."""
        return self._entries.get((first, second), [])


class BodyImpulseQuery:
    """Asks for the net contact impulse on each body."""

    def __init__(self, bodies: Sequence[Any]) -> None:
        self.cuda_impulses = Impulses(len(bodies))
        self._rows: dict[Any, list[int]] = defaultdict(list)
        for row, body in enumerate(bodies):
            self._rows[body].append(row)

    def entries(self, first: Any, second: Any) -> _Entries:
        """Rows and signs for a contact between two bodies; empty when it is none of ours."""
        on_first = [(row, 1) for row in self._rows.get(first, ())]
        return on_first + [(row, -1) for row in self._rows.get(second, ())]


Query = TypeVar("Query", PairImpulseQuery, BodyImpulseQuery)


class ContactReader:
    """Walks through the contacts of all scenes at most once a substep, for all queries."""

    def __init__(self, systems: Sequence[physx.PhysxCpuSystem]) -> None:
        self._systems = systems
        self._queries: list[PairImpulseQuery | BodyImpulseQuery] = []
        self._answered = False
        self._forgotten: set[int] = set(range(len(systems)))

    def register(self, query: Query) -> Query:
        """Answer this query too from now on."""
        self._queries.append(query)
        self._answered = False
        return query

    def invalidate(self) -> None:
        """All scenes have taken a substep."""
        self._answered = False
        self._forgotten.clear()

    def forget(self, scene: int) -> None:
        """A scene was set to another state: it has no contacts until its next substep."""
        self._answered = False
        self._forgotten.add(scene)

    def answer(self, query: PairImpulseQuery | BodyImpulseQuery) -> None:
        """Bring a query's result up to date."""
        if not self._answered:
            self._read()

    def _read(self) -> None:
        totals = [np.zeros(q.cuda_impulses.array.shape) for q in self._queries]
        for scene, system in enumerate(self._systems):
            if scene in self._forgotten:
                continue
            for contact in system.get_contacts():
                first, second = contact.bodies
                impulse = None
                for query, total in zip(self._queries, totals, strict=True):
                    for row, sign in query.entries(first, second):
                        if impulse is None:
                            impulse = np.sum([p.impulse for p in contact.points], axis=0)
                        total[row] += sign * impulse
        for query, total in zip(self._queries, totals, strict=True):
            query.cuda_impulses.array[:] = total
        self._answered = True
