"""Which parameters of a test belong to the default run."""

from collections.abc import Sequence

import pytest


def long_except(names: Sequence, *kept) -> list:
    """As `slow_except`, for tests that take seconds each."""
    return [pytest.param(n, marks=() if n in kept else pytest.mark.long) for n in names]


def slow_except(names: Sequence, *kept) -> list:
    """Parameters of which only ``kept`` belong to the default run; they stand for the others."""
    return [pytest.param(n, marks=() if n in kept else pytest.mark.slow) for n in names]
