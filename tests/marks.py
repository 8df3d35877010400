"""Which tests belong to the default run, and which need a package that may be missing."""

from collections.abc import Sequence
from typing import Any

import pytest

from symsteer.errors import UserError
from symsteer.extras import EXTRAS
from symsteer.policies import POLICIES
from symsteer.policies.geometry import escnn_package


def need(extra: str) -> None:
    """Without the packages of an extra, what calls this is skipped."""
    for module in EXTRAS[extra]:
        pytest.importorskip(module, exc_type=ImportError)


def need_escnn() -> Any:
    """The package as our policy uses it; without it, what calls this is skipped."""
    try:
        return escnn_package()
    except UserError as error:
        pytest.skip(str(error), allow_module_level=True)


def policy_class(name: str) -> Any:
    """The class of a base policy; that of escnn is skipped without escnn."""
    if name == "escnn":
        need_escnn()
    return POLICIES.get(name)


def long_except(names: Sequence, *kept) -> list:
    """As `slow_except`, for tests that take seconds each."""
    return [pytest.param(n, marks=() if n in kept else pytest.mark.long) for n in names]


def slow_except(names: Sequence, *kept) -> list:
    """Parameters of which only ``kept`` belong to the default run; they stand for the others."""
    return [pytest.param(n, marks=() if n in kept else pytest.mark.slow) for n in names]
