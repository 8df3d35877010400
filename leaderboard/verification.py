"""Whether a leaderboard on disk is what its records give: every byte of every file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

DRAWN_WITH = ("matplotlib", "numpy", "pandas", "scipy")
"""Packages whose version may change a file's bytes."""

REQUIREMENTS = Path(__file__).resolve().parents[1] / "requirements.txt"


@dataclass(frozen=True)
class Verification:
    """How many records and files were compared, and one line for each file that differs."""

    records: int
    files: int
    differences: list[str]


def differences(files: Mapping[str, bytes], stale: list[str], out: Path) -> list[str]:
    """One line for every file of the folder `out` that is not as the records give it.

    Args:
        files: what the records give, by path relative to `out` (`report.render`).
        stale: files of `out` that belong to an older leaderboard, relative to `out`.
    """
    lines = []
    for name, wanted in sorted(files.items()):
        path = out / name
        try:
            with open(path, "rb") as file:
                # One byte more than wanted tells a longer file, however large it is.
                written = file.read(len(wanted) + 1)
        except FileNotFoundError:
            lines.append(f"{path}: missing")
        except OSError as error:
            lines.append(f"{path}: cannot be read ({error.strerror})")
        else:
            if written != wanted:
                lines.append(f"{path}: {_first_difference(written, wanted)}")
    return lines + [f"{out / name}: no record gives this file" for name in stale]


def other_versions() -> list[str]:
    """Packages that are not of the pinned version, as "name version, pinned: version"."""
    try:
        pins = dict(re.findall(r"^([a-z0-9.-]+)==(\S+)$", REQUIREMENTS.read_text(), re.M))
    except OSError:  # an installed package has no list of pinned versions
        return []
    return [
        f"{name} {version}, pinned: {pins[name]}"
        for name in DRAWN_WITH
        if name in pins and (version := metadata.version(name)) != pins[name]
    ]


def _first_difference(written: bytes, wanted: bytes) -> str:
    length = min(len(written), len(wanted))
    index = next((i for i in range(length) if written[i] != wanted[i]), length)
    line = wanted[:index].count(b"\n") + 1
    return f"differs from line {line} on"
