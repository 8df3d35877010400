"""Calls `symsteer report` without the program around it, which prints errors in the same way; calls
git."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import tyro

from symsteer.errors import UserError
from symsteer.leaderboard.command import report


def main(arguments: Sequence[str]) -> int:
    """The exit code."""
    try:
        return tyro.cli(report, args=list(arguments))
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def git(folder: Path, *arguments: str) -> str:
    """What git prints in a folder, with a name of ours."""
    identity = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"]
    command = ["git", "-C", str(folder), *identity, *arguments]
    return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
