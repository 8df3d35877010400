"""The simulator releases that the batched CPU physics was written for."""

from __future__ import annotations

from importlib.metadata import version

from symsteer.errors import UserError

PINNED = {"mani-skill": "3.0.1", "sapien": "3.0.3"}


def check_versions() -> None:
    """Raise `UserError` unless the installed simulator has the pinned versions."""
    for package, wanted in PINNED.items():
        if (installed := version(package)) != wanted:
            raise UserError(
                f"SymSteer is written for {package} {wanted}, but {installed} is installed: "
                f'run "pip install {package}=={wanted}".'
            )
