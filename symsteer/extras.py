"""Packages that only a part of SymSteer needs: the extras of pyproject.toml."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

from symsteer.registry import NotInstalledError

EXTRAS = {
    "escnn": ("escnn.nn",),
    "lerobot": ("pandas", "pyarrow.parquet"),
    "ray": ("grpc", "ray"),
    "site": ("itables", "jinja2", "markdown_it", "mkdocs", "material", "plotly"),
    "slurm": ("submitit",),
    "tune": ("optuna",),
    "wandb": ("wandb",),
}
"""What each extra must be able to import."""


def command(name: str) -> str:
    """How to install an extra."""
    if name == "escnn":
        # It asks for packages that must be compiled, and that our use of it does without.
        return "pip install --no-deps escnn==1.0.11 joblib"
    return f'pip install "symsteer[{name}]"'


@contextlib.contextmanager
def extra(name: str, what: str) -> Iterator[None]:
    """Inside, a package that cannot be imported gives one sentence with the command.

    Args:
        name: the extra that has the packages.
        what: what needs them.

    Raises:
        NotInstalledError: in the place of an ImportError.
    """
    try:
        yield
    except ImportError as error:
        if (error.name or "").partition(".")[0] == "symsteer":
            raise
        raise NotInstalledError(
            f"{what} needs the extra {name}, which cannot be imported ({error}); install it with: "
            f"{command(name)}"
        ) from error
