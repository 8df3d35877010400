"""SymSteer: how much symmetry should RL keep when it steers an equivariant diffusion policy?

The public names are those in ``__all__``. Everything else may change between versions
(docs/api.md). They are imported on first use, so ``import symsteer`` is fast.
"""

import sys

# `python -m symsteer` begins with the current folder in front of all others, whoever wrote what is
# in it. Nothing may be imported from there, so this comes before all other imports.
if sys.argv[:1] == ["-m"] and not sys.flags.safe_path:
    del sys.path[0]

TYPE_CHECKING = False
if TYPE_CHECKING:
    from symsteer.bench.runs.trained import load
    from symsteer.bench.tasks import make
    from symsteer.errors import UserError
    from symsteer.leaderboard.run_table import read_records

    __version__: str

__all__ = ["UserError", "__version__", "load", "make", "read_records"]

_HOME = {
    "UserError": "symsteer.errors",
    "load": "symsteer.bench.runs.trained",
    "make": "symsteer.bench.tasks",
    "read_records": "symsteer.leaderboard.run_table",
}


def __getattr__(name: str) -> object:
    import importlib

    if name == "__version__":
        from importlib.metadata import version

        return version("symsteer")
    if name in _HOME:
        return getattr(importlib.import_module(_HOME[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
