"""Which parameters of a test belong to the default run."""

from collections.abc import Sequence

import pytest


def first(names: Sequence[str], *kept: str) -> list:
    """Parameters of which all but ``kept`` are slow: one stands for the others."""
    return [pytest.param(n, marks=() if n in kept else pytest.mark.slow) for n in names]
