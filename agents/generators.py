"""Streams of random numbers that a checkpoint continues."""

from __future__ import annotations

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
