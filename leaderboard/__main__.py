"""`python -m leaderboard [RECORDS ...] [--out FOLDER]`: generate the leaderboard from records."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path

from leaderboard.errors import RecordError
from leaderboard.report import DEFAULT_OUT, DEFAULT_RECORDS, generate


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code: 0, or 2 with one sentence on stderr for bad records."""
    parser = argparse.ArgumentParser(
        prog="python -m leaderboard",
        description="Write LEADERBOARD.md, leaderboard.csv and figures from run records.",
    )
    parser.add_argument(
        "records",
        nargs="*",
        type=Path,
        default=[DEFAULT_RECORDS],
        metavar="RECORDS",
        help="record files, run folders or folders of either (default: %(default)s)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=DEFAULT_OUT,
        metavar="FOLDER",
        help="where the leaderboard is written (default: %(default)s)",
    )
    options = parser.parse_args(arguments)
    try:
        files = generate(options.records, options.out)
    except RecordError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    page = next(file for file in files if file.name == "LEADERBOARD.md")
    print(f"wrote {page} and {len(files) - 1} files beside it")
    return 0


if __name__ == "__main__":
    sys.exit(main())
