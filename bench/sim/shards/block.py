"""Shared memory, and how a tree of tensors is stored in it.

A tree (nested dictionaries, lists and tuples) is split into *rows*, tensors whose first axis counts
environments, and a *skeleton* with everything else. Memory is ordered by field, and each field
has room for the environments of all workers: a worker writes its slice of every field, and the
caller's process reads whole fields without concatenating.
"""

from __future__ import annotations

import mmap
import os
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.reduction import DupFd
from typing import Any

import torch

_ALIGNMENT = 64


@dataclass(frozen=True)
class Slot:
    """Marks the place of rows in a skeleton."""

    index: int


@dataclass(frozen=True)
class Field:
    """Type of a tensor of rows, and the shape of one row."""

    dtype: torch.dtype
    shape: tuple[int, ...]

    @classmethod
    def of(cls, rows: torch.Tensor) -> Field:
        """The field that ``rows [n, ...]`` is a part of."""
        return cls(rows.dtype, tuple(rows.shape[1:]))

    def bytes(self, count: int) -> int:
        """Size of ``count`` rows, rounded up to the alignment."""
        size = count * self.dtype.itemsize * int(torch.Size(self.shape).numel())
        return -(-size // _ALIGNMENT) * _ALIGNMENT


def take_apart(tree: Any, count: int, rows: list[torch.Tensor]) -> Any:
    """Append the tensors with ``count`` rows to ``rows``; returns the skeleton."""
    if isinstance(tree, torch.Tensor):
        if tree.ndim and len(tree) == count:
            rows.append(tree)
            return Slot(len(rows) - 1)
        return tree
    if isinstance(tree, dict):
        return {key: take_apart(value, count, rows) for key, value in tree.items()}
    if isinstance(tree, list | tuple):
        return type(tree)([take_apart(value, count, rows) for value in tree])
    return tree


def put_together(skeleton: Any, rows: Sequence[torch.Tensor]) -> Any:
    """Inverse of `take_apart`."""
    if isinstance(skeleton, Slot):
        return rows[skeleton.index]
    if isinstance(skeleton, dict):
        return {key: put_together(value, rows) for key, value in skeleton.items()}
    if isinstance(skeleton, list | tuple):
        return type(skeleton)([put_together(value, rows) for value in skeleton])
    return skeleton


def select(tree: Any, count: int, index: Any) -> Any:
    """The tree with only some of the ``count`` rows of every tensor."""
    rows: list[torch.Tensor] = []
    skeleton = take_apart(tree, count, rows)
    return put_together(skeleton, [row[index] for row in rows])


class SharedBlock:
    """Anonymous shared memory; pickled only while a worker process is started.

    It has no name, so the system frees it with the last process that uses it. Pages take memory
    once they are written.

    Args:
        size: in bytes.
        count: number of environments, the rows of each field.
    """

    def __init__(self, size: int, count: int) -> None:
        self.size, self.count = size, count
        self._fd = os.memfd_create("symsteer-shards")
        os.ftruncate(self._fd, size)
        self._map()

    def _map(self) -> None:
        self._memory = mmap.mmap(self._fd, self.size)
        self._layouts: dict[tuple[Field, ...], list[torch.Tensor]] = {}

    def __getstate__(self) -> dict[str, Any]:
        return {"size": self.size, "count": self.count, "fd": DupFd(self._fd)}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.size, self.count = state["size"], state["count"]
        self._fd = state["fd"].detach()
        self._map()

    def close_descriptor(self) -> None:
        """Close the file descriptor, once all workers have theirs; the memory stays mapped."""
        os.close(self._fd)

    def fits(self, fields: Sequence[Field]) -> bool:
        """Whether there is room for these fields."""
        return sum(field.bytes(self.count) for field in fields) <= self.size

    def fields(self, fields: tuple[Field, ...]) -> list[torch.Tensor]:
        """Tensors ``[count, ...]`` that share this memory, one for each field."""
        views = self._layouts.get(fields)
        if views is None:
            views, offset = [], 0
            for field in fields:
                number = self.count * int(torch.Size(field.shape).numel())
                if number:
                    flat = torch.frombuffer(
                        self._memory, dtype=field.dtype, count=number, offset=offset
                    )
                    views.append(flat.view(self.count, *field.shape))
                else:
                    views.append(torch.empty(self.count, *field.shape, dtype=field.dtype))
                offset += field.bytes(self.count)
            self._layouts[fields] = views
        return views
