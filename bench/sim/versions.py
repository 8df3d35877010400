"""The simulator releases that the batched CPU physics was written for."""

from __future__ import annotations

import os
from importlib import metadata

TESTED = {"mani-skill": "3.0.1", "sapien": "3.0.3"}
"""The range that SymSteer is tested with."""

_SAID = "SYMSTEER_VERSIONS_SAID"


def installed() -> dict[str, str]:
    """Names and versions of the installed distributions that bring the simulator."""
    return dict(filter(None, map(_distribution_of, TESTED)))


def untested() -> str:
    """A sentence if another release of the simulator than the tested ones is installed, else ""."""
    others = [f"{name} {version}" for name, version in installed().items() - TESTED.items()]
    if not others:
        return ""
    tested = " and ".join(f"{name} {version}" for name, version in TESTED.items())
    return (
        f"SymSteer is tested with {tested}; {' and '.join(sorted(others))} may give other results, "
        "or not work"
    )


def first_warning() -> str:
    """As `untested`, but once only in this process and those that it starts, later ""."""
    if _SAID in os.environ:
        return ""
    os.environ[_SAID] = "1"
    return untested()


def _distribution_of(name: str) -> tuple[str, str] | None:
    """A distribution's name and version, or those of one that has the same package (a nightly)."""
    try:
        return name, metadata.version(name)
    except metadata.PackageNotFoundError:
        owners = metadata.packages_distributions().get(name.replace("-", "_"), [])
        return (owners[0], metadata.version(owners[0])) if owners else None
