"""Calls `symsteer report` without the program around it, which prints errors in the same way."""

from __future__ import annotations

import sys
from collections.abc import Sequence

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
