"""SymSteer: how much symmetry should RL keep when it steers an equivariant diffusion policy?

The public names are those in ``__all__``. Everything else may change between versions
(docs/api.md). They are imported on first use, so ``import symsteer`` is fast.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from symsteer.errors import UserError

if TYPE_CHECKING:
    from symsteer.bench.runs.trained import load
    from symsteer.bench.tasks import make

    __version__: str

__all__ = ["UserError", "__version__", "load", "make"]

_HOME = {"load": "symsteer.bench.runs.trained", "make": "symsteer.bench.tasks"}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("symsteer")
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
