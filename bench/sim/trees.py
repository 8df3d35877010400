"""Trees of tensors: dictionaries, dataclasses, lists and tuples of tensors, nested."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import torch


def map_trees(function: Callable[..., Any], *trees: Any) -> Any:
    """Apply a function to the corresponding tensors or arrays of dictionaries and dataclasses."""
    first = trees[0]
    if isinstance(first, dict):
        return {key: map_trees(function, *(tree[key] for tree in trees)) for key in first}
    if is_dataclass(first) and not isinstance(first, type):
        names = [f.name for f in fields(first)]
        values = {n: map_trees(function, *(getattr(tree, n) for tree in trees)) for n in names}
        return type(first)(**values)
    return function(*trees)


def join_trees(trees: Sequence[Any]) -> Any:
    """Concatenate trees of ``[S_i, ...]``."""
    return map_trees(lambda *tensors: torch.cat(tensors), *trees)


def rows_of(tree: Any, rows: Any) -> Any:
    """Some rows of a tree of ``[S, ...]``."""
    return map_trees(lambda tensor: tensor[rows], tree)


def write_rows(target: Any, source: Any, rows: Any) -> None:
    """Write a tree, whose tensors have one row per entry of ``rows``, into those rows."""

    def write(value: torch.Tensor, new: Any) -> None:
        value[rows] = torch.as_tensor(new, device=value.device, dtype=value.dtype)

    map_trees(write, target, source)


def select(tree: Any, count: int, rows: Any) -> Any:
    """The tree with some rows of what has ``count`` rows; all else stays as it is."""
    if isinstance(tree, dict):
        return {key: select(value, count, rows) for key, value in tree.items()}
    has_rows = isinstance(tree, np.ndarray | torch.Tensor) and tree.ndim and len(tree) == count
    return tree[rows] if has_rows else tree


def merge(
    trees: Sequence[Any],
    counts: Sequence[int],
    combine: Callable[[list[torch.Tensor]], torch.Tensor],
) -> Any:
    """Combine the corresponding tensors of trees that have ``counts`` rows.

    All else, such as a number, is taken from the last tree.
    """
    last = trees[-1]
    if isinstance(last, dict):
        return {key: merge([tree[key] for tree in trees], counts, combine) for key in last}
    if isinstance(last, list | tuple):
        return type(last)(merge(items, counts, combine) for items in zip(*trees, strict=True))
    have_rows = isinstance(last, torch.Tensor) and last.ndim and len(last) == counts[-1]
    return combine(list(trees)) if have_rows else last
