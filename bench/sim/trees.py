"""Trees of tensors: dictionaries and dataclasses of tensors, nested."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass
from typing import Any

import torch


def map_trees(function: Callable[..., Any], *trees: Any) -> Any:
    """Apply a function to the corresponding tensors or arrays of trees."""
    first = trees[0]
    if isinstance(first, dict):
        return {key: map_trees(function, *(tree[key] for tree in trees)) for key in first}
    if is_dataclass(first) and not isinstance(first, type):
        names = [f.name for f in fields(first)]
        parts = {n: map_trees(function, *(getattr(tree, n) for tree in trees)) for n in names}
        return type(first)(**parts)
    return function(*trees)


def join_trees(trees: Sequence[Any]) -> Any:
    """Concatenate trees of ``[S_i, ...]``."""
    return map_trees(lambda *tensors: torch.cat(tensors), *trees)


def rows_of(tree: Any, rows: Any) -> Any:
    """Some rows of a tree of ``[S, ...]``."""
    return map_trees(lambda tensor: tensor[rows], tree)
