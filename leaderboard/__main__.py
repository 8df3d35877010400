"""`python -m leaderboard`: generate the leaderboard from records, verify it, or check records."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TextIO

from symsteer.leaderboard.admission import check
from symsteer.leaderboard.errors import RecordError
from symsteer.leaderboard.report import DEFAULT_OUT, DEFAULT_RECORDS, generate, verify
from symsteer.leaderboard.verification import other_versions

FEW = 10
"""Of more records than these, `--check` names only those that it has something to say about."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code.

    0: done, or nothing to complain about; 1: `--verify` found a difference; 2: `--check` found a
    record that is not admissible, or the input is wrong (one sentence on stderr).
    """
    parser = argparse.ArgumentParser(
        prog="python -m leaderboard",
        description="Write LEADERBOARD.md, leaderboard.csv and figures from run records.",
    )
    parser.add_argument(
        "records",
        nargs="*",
        type=Path,
        metavar="RECORDS",
        help="record files, run folders or folders of either (default: the committed records)",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=DEFAULT_OUT,
        metavar="FOLDER",
        help="where the leaderboard is written (default: the leaderboard folder of the repository)",
    )
    parser.add_argument(
        "--audit",
        type=Path,
        metavar="FILE",
        help="summary.json of an audit, for the map (default: the committed one)",
    )
    instead = parser.add_mutually_exclusive_group()
    instead.add_argument(
        "--verify",
        action="store_true",
        help="write nothing; fail if FOLDER holds anything else than what RECORDS give",
    )
    instead.add_argument(
        "--check",
        action="store_true",
        help="write nothing; say of each of RECORDS whether the leaderboard admits it",
    )
    options = parser.parse_args(arguments)
    # A path may hold bytes that are no text.
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    records = options.records or [DEFAULT_RECORDS]
    try:
        if options.check:
            return _check(records)
        if options.verify:
            return _verify(records, options.out, options.audit)
        files = generate(records, options.out, options.audit)
    except RecordError as error:
        _say(f"error: {error}", sys.stderr)
        return 2
    page = next(file for file in files if file.name == "LEADERBOARD.md")
    _say(f"wrote {page} and {len(files) - 1} files beside it")
    return 0


def _verify(records: Sequence[Path], out: Path, audit: Path | None) -> int:
    result = verify(records, out, audit)
    if not result.differences:
        _say(f"{result.records} records and {result.files} files of the leaderboard agree")
        return 0
    for line in result.differences:
        _say(line)
    for package in other_versions():
        _say(f"note: bytes are promised for the pinned versions only; here is {package}")
    number = len(result.differences)
    _say(
        f"error: {number} file{'s'[: number != 1]} of the leaderboard did not come from these "
        f"{result.records} records: run `symsteer report` with the same arguments.",
        sys.stderr,
    )
    return 1


def _check(records: Sequence[Path]) -> int:
    verdicts = check(records, DEFAULT_RECORDS)
    for verdict in verdicts:
        if verdict.is_admissible and not verdict.notes and len(verdicts) > FEW:
            continue
        _say(f"{verdict.path}: {'admissible' if verdict.is_admissible else 'NOT ADMISSIBLE'}")
        for problem in verdict.problems:
            _say(f"  problem: {problem}")
        for note in verdict.notes:
            _say(f"  note: {note}")
    admitted = sum(verdict.is_admissible for verdict in verdicts)
    _say(f"{admitted} of {len(verdicts)} records are admissible")
    return 0 if admitted == len(verdicts) else 2


def _say(text: str, stream: TextIO | None = None) -> None:
    """Print one line, whatever text a record brought into it."""
    line = "".join(c if c.isprintable() or "\udc80" <= c <= "\udcff" else "?" for c in text)
    print(line, file=stream or sys.stdout)


if __name__ == "__main__":
    sys.exit(main())
