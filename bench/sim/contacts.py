"""Contact impulses of N CPU scenes, in the shape of SAPIEN's GPU contact queries.

Impulses are those of the last substep, in newton seconds, summed over the contact points of a
pair. A pair's impulse acts on its first body; a body's impulse is what all others do to it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
import sapien.physx as physx
import torch

# Row and sign with which a contact's impulse enters a result.
_Entries = list[tuple[int, int]]


class Buffer:
    """An array that numpy and torch share, with the ``.torch()`` of SAPIEN's CudaArray.

    Args:
        array: the shared array.
        fill: called before each ``.torch()``; for buffers that are filled on demand.
    """

    def __init__(self, array: np.ndarray, fill: Callable[[], None] | None = None) -> None:
        self.array = array
        self._tensor = torch.from_numpy(array)
        self._fill = fill

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""
        return self.array.shape

    def torch(self) -> torch.Tensor:
        """The array as a tensor; both share memory."""
        if self._fill is not None:
            self._fill()
        return self._tensor


def _impulses(n: int) -> Buffer:
    """The result of a query, ``[n, 3]``."""
    return Buffer(np.zeros((n, 3), dtype=np.float32))


class PairImpulseQuery:
    """Asks for the impulse on the first body of each pair by the second one."""

    start = 0
    """First of its rows among those of all queries."""

    def __init__(self, body_pairs: Sequence[tuple[Any, Any]]) -> None:
        self.cuda_impulses = _impulses(len(body_pairs))
        self._entries: dict[tuple[Any, Any], _Entries] = defaultdict(list)
        for row, (first, second) in enumerate(body_pairs):
            self._entries[first, second].append((row, 1))
            self._entries[second, first].append((row, -1))

    def entries(self, first: Any, second: Any) -> _Entries:
        """Rows and signs of a contact between two bodies; empty if the query has no such pair."""
        return self._entries.get((first, second), [])


class BodyImpulseQuery:
    """Asks for the net contact impulse on each body."""

    start = 0
    """First of its rows among those of all queries."""

    def __init__(self, bodies: Sequence[Any]) -> None:
        self.cuda_impulses = _impulses(len(bodies))
        self._rows: dict[Any, list[int]] = defaultdict(list)
        for row, body in enumerate(bodies):
            self._rows[body].append(row)

    def entries(self, first: Any, second: Any) -> _Entries:
        """Rows and signs of a contact between two bodies; empty if the query has neither."""
        on_first = [(row, 1) for row in self._rows.get(first, ())]
        return on_first + [(row, -1) for row in self._rows.get(second, ())]


Query = TypeVar("Query", PairImpulseQuery, BodyImpulseQuery)


@dataclass
class _Found:
    """The contact points of one scene that enter a result: impulse, row and sign."""

    impulses: list[np.ndarray] = field(default_factory=list)
    rows: list[int] = field(default_factory=list)
    signs: list[int] = field(default_factory=list)


class ContactReader:
    """Reads the contacts of all scenes at most once per substep, for all queries."""

    def __init__(self, systems: Sequence[physx.PhysxCpuSystem]) -> None:
        self._systems = systems
        self._queries: list[PairImpulseQuery | BodyImpulseQuery] = []
        self._found = [_Found() for _ in systems]
        self._forgotten: set[int] = set(range(len(systems)))
        self._must_read = True
        self._must_sum = True
        # What a contact between two bodies enters, filled as pairs come into contact.
        self._known_pairs: dict[tuple[Any, Any], _Entries] = {}

    def register(self, query: Query) -> Query:
        """Add a query."""
        query.start = sum(len(earlier.cuda_impulses.array) for earlier in self._queries)
        self._queries.append(query)
        self._known_pairs.clear()
        self._must_read = True
        return query

    def invalidate(self) -> None:
        """Mark all contacts as out of date, after a substep of all scenes."""
        self._must_read = True
        self._forgotten.clear()

    def forget(self, scene: int) -> None:
        """Drop the contacts of a scene whose state was set, until its next substep."""
        self._forgotten.add(scene)
        self._found[scene] = _Found()
        self._must_sum = True

    def answer(self, query: PairImpulseQuery | BodyImpulseQuery) -> None:
        """Update the results of all queries."""
        if self._must_read:
            self._read()
        if self._must_sum:
            self._sum()

    def _read(self) -> None:
        for scene, system in enumerate(self._systems):
            found = self._found[scene] = _Found()
            if scene in self._forgotten:
                continue
            for contact in system.get_contacts():
                pair = tuple(contact.bodies)
                entries = self._known_pairs.get(pair)
                if entries is None:
                    entries = self._known_pairs[pair] = self._entries(*pair)
                if entries:
                    impulses = [point.impulse for point in contact.points]
                    for row, sign in entries:
                        found.impulses += impulses
                        found.rows += [row] * len(impulses)
                        found.signs += [sign] * len(impulses)
        self._must_read = False
        self._must_sum = True

    def _entries(self, first: Any, second: Any) -> _Entries:
        return [
            (query.start + row, sign)
            for query in self._queries
            for row, sign in query.entries(first, second)
        ]

    def _sum(self) -> None:
        """One sum for all queries, whose rows follow each other."""
        count = sum(len(query.cuda_impulses.array) for query in self._queries)
        impulses = [impulse for found in self._found for impulse in found.impulses]
        total = np.zeros((count, 3))
        if impulses:
            signs = np.array([sign for found in self._found for sign in found.signs])
            rows = np.array([row for found in self._found for row in found.rows])
            signed = signs[:, None] * np.concatenate(impulses).reshape(-1, 3)
            for axis in range(3):
                total[:, axis] = np.bincount(rows, signed[:, axis], count)
        for query in self._queries:
            array = query.cuda_impulses.array
            array[:] = total[query.start : query.start + len(array)]
        self._must_sum = False
