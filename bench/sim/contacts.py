"""Contact impulses of N CPU scenes, in the shape of SAPIEN's GPU contact queries.

Impulses are those of the last substep, in newton seconds, summed over the contact points of a
pair. A pair's impulse acts on its first body; a body's impulse is what all others do to it.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import sapien.physx as physx
import torch
from mani_skill.utils.common import compute_angle_between
from mani_skill.utils.geometry.rotation_conversions import quaternion_to_matrix


class Buffer:
    """An array that numpy and torch share, with the ``.torch()`` of SAPIEN's CudaArray."""

    def __init__(self, array: np.ndarray) -> None:
        self.array = array
        self.shape = array.shape
        self._tensor = torch.from_numpy(array)

    def torch(self) -> torch.Tensor:
        """The array as a tensor; both share memory."""
        return self._tensor


class ImpulseQuery:
    """Asks for impulses, each between two bodies or on one body.

    Attributes:
        start: first of its rows among those of all queries.
        rows: rows and signs by pair of bodies, or by body and None for any other one.
        cuda_impulses: the answer, ``[number of rows, 3]``.
    """

    def __init__(self, start: int, bodies: Iterable[tuple[Any, Any]]) -> None:
        self.start = start
        self.rows: dict[tuple[Any, Any], list[tuple[int, int]]] = defaultdict(list)
        count = 0
        for first, second in bodies:
            self.rows[first, second].append((start + count, 1))
            self.rows[second, first].append((start + count, -1))
            count += 1
        self.cuda_impulses = Buffer(np.zeros((count, 3), dtype=np.float32))

    def entries(self, first: Any, second: Any) -> list[tuple[int, int]]:
        """Rows that a contact between two bodies enters, and with which sign."""
        keys = ((first, second), (first, None), (None, second))
        return [entry for key in keys for entry in self.rows.get(key, ())]


class ContactReader:
    """Reads the contacts of each scene at most once per substep, for all queries."""

    def __init__(self, systems: Sequence[physx.PhysxCpuSystem]) -> None:
        self._systems = systems
        self._queries: list[ImpulseQuery] = []
        # Of each scene, for every contact point that enters a result: impulse, row and sign.
        self._points: list[list[tuple[np.ndarray, int, int]]] = [[] for _ in systems]
        self._forgotten: set[int] = set(range(len(systems)))
        self._unread: set[int] = set()
        self._must_sum = True
        # What a contact between two bodies enters, filled as pairs come into contact.
        self._known_pairs: dict[tuple[Any, Any], list[tuple[int, int]]] = {}

    def register(self, bodies: Iterable[tuple[Any, Any]]) -> ImpulseQuery:
        """A new query for pairs of bodies; None instead of the second one for any other."""
        query = ImpulseQuery(sum(len(q.cuda_impulses.array) for q in self._queries), bodies)
        self._queries.append(query)
        self._known_pairs.clear()
        self._unread = set(range(len(self._systems))) - self._forgotten
        return query

    def invalidate(self, scenes: Iterable[int]) -> None:
        """Mark the contacts of scenes as out of date, after a substep of these."""
        self._unread.update(scenes)
        self._forgotten.difference_update(scenes)

    def forget(self, scene: int) -> None:
        """Drop the contacts of a scene whose state was set, until its next substep."""
        self._forgotten.add(scene)
        self._unread.discard(scene)
        self._points[scene] = []
        self._must_sum = True

    def update(self) -> None:
        """Update the results of all queries."""
        for scene in self._unread:
            self._points[scene] = self._read(self._systems[scene])
        if self._unread or self._must_sum:
            self._unread.clear()
            self._sum()
            self._must_sum = False

    def _read(self, system: physx.PhysxCpuSystem) -> list[tuple[np.ndarray, int, int]]:
        points = []
        for contact in system.get_contacts():
            pair = tuple(contact.bodies)
            entries = self._known_pairs.get(pair)
            if entries is None:
                entries = [e for query in self._queries for e in query.entries(*pair)]
                self._known_pairs[pair] = entries
            if entries:
                impulses = [point.impulse for point in contact.points]
                points += [(impulse, *entry) for entry in entries for impulse in impulses]
        return points

    def _sum(self) -> None:
        """One sum for all queries, whose rows follow each other."""
        count = sum(len(query.cuda_impulses.array) for query in self._queries)
        total = np.zeros((count, 3))
        points = [point for scene in self._points for point in scene]
        if points:
            impulses, rows, signs = zip(*points, strict=True)
            signed = np.array(signs)[:, None] * np.concatenate(impulses).reshape(-1, 3)
            for axis in range(3):
                total[:, axis] = np.bincount(rows, signed[:, axis], count)
        for query in self._queries:
            array = query.cuda_impulses.array
            array[:] = total[query.start : query.start + len(array)]


def is_grasping(robot: Any, body: Any, min_force: float = 0.5, max_angle: float = 85) -> Any:
    """``Panda.is_grasping`` of ManiSkill, ``[N]`` bool, with both fingers in one operation."""
    fingers = robot.finger1_link, robot.finger2_link
    force = torch.cat([robot.scene.get_pairwise_contact_forces(f, body) for f in fingers])
    pressing = torch.linalg.norm(force, axis=1) >= min_force
    if pressing.any():
        opening = quaternion_to_matrix(torch.cat([f.pose.q for f in fingers]))[:, :, 1]
        opening[len(force) // 2 :] *= -1
        pressing &= torch.rad2deg(compute_angle_between(opening, force)) <= max_angle
    return pressing.view(2, -1).all(dim=0)
