"""Streams of random numbers and tensors that a checkpoint continues."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch


def continue_stream(generator: torch.Generator, state: torch.Tensor) -> None:
    """Go on with a stored stream; one of another kind of device is left out.

    A GPU draws other numbers than a processor. So an agent that was trained on one can act on the
    other, with the stream of its own seed.

    Args:
        generator: is changed.
        state: from ``get_state()`` of a generator on the same kind of device, or another one.
    """
    state = state.cpu()
    if state.shape == generator.get_state().shape:
        generator.set_state(state)
    elif state.shape not in ((16,), (5056,)):  # of a GPU, of a processor
        raise ValueError(f"the state of a generator has the shape {list(state.shape)}")


def tensor_like(stored: torch.Tensor, like: torch.Tensor) -> torch.Tensor:
    """A stored tensor as another is; a copy would repeat one of another shape, so it is refused."""
    if stored.shape != like.shape:
        raise ValueError(f"a tensor has the shape {list(stored.shape)}, not {list(like.shape)}")
    return stored.to(like)


def owned(tree: Any) -> Any:
    """A copy with tensors in memory of their own: those of a team's member are views."""
    if isinstance(tree, torch.Tensor):
        return tree.detach().clone()
    if isinstance(tree, Mapping):
        return {key: owned(value) for key, value in tree.items()}
    return [owned(value) for value in tree] if isinstance(tree, list) else tree
