"""Writes the tables of docs/detect.md.

python -m symsteer.bench.detect.page                     # from the committed summary
python -m symsteer.bench.detect.page OUT/summary.json    # replaces the committed summary first

The committed summary is leaderboard/results/detectors/summary.json.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path

from symsteer.bench.detect.report import summary_text
from symsteer.bench.pages import CHECKOUT, check_checkout, with_tables
from symsteer.errors import UserError
from symsteer.files import write_together
from symsteer.terminal import complain

PAGE = CHECKOUT / "docs" / "detect.md"
SUMMARY = CHECKOUT / "leaderboard" / "results" / "detectors" / "summary.json"


def main(arguments: Sequence[str]) -> int:
    """Write docs/detect.md; returns the exit code."""
    path = Path(arguments[0]) if arguments else SUMMARY
    try:
        check_checkout(PAGE)
        try:
            text = path.read_text()
            tables = summary_text(json.loads(text))
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise UserError(
                f"{path} cannot be read ({error}); name the summary.json of `symsteer detect`"
            ) from None
        page = with_tables(PAGE.read_text(), tables, "docs/detect.md")
        write_together({SUMMARY: text.encode(), PAGE: page.encode()})
    except UserError as error:
        return complain(error, f"error: {error}", 2)
    print(f"wrote the tables of {PAGE}")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
