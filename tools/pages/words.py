"""Writes the tables of docs/words.md.

python -m tools.pages.words         # from leaderboard/results/words/words.json
python -m tools.pages.words FILE    # from what `python -m tools.words` printed
"""

from __future__ import annotations

import json
import statistics
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from symsteer.errors import UserError
from symsteer.tables import markdown
from tools.pages.marks import CHECKOUT, write_tables
from tools.pages.minima import interval, spread

PAGE = CHECKOUT / "docs" / "words.md"
RESULTS = CHECKOUT / "leaderboard" / "results" / "words" / "words.json"

Row = Mapping[str, Any]

SHOWN = {
    "`edp-joint`, one-hot": "one_hot",
    "`edp-told`, words of the training": "training",
    "held-out words": "held_out",
    "words of another task": "another_task",
}


def successes(rows: Sequence[Row]) -> str:
    """By task, mean [lowest, highest] over the seeds."""
    lines = []
    for task in dict.fromkeys(row["task"] for row in rows):
        found = [row for row in rows if row["task"] == task]
        lines.append([task, *(spread([row[key] for row in found]) for key in SHOWN.values())])
    every = [spread(means(rows, key)) for key in SHOWN.values()]
    return markdown(["task", *SHOWN], [*lines, ["mean of the tasks", *every]])


def differences(rows: Sequence[Row]) -> str:
    """Of the means over the tasks, with 95 % intervals over the seeds."""
    pairs = {
        "words of the training minus one-hot": ("training", "one_hot"),
        "held-out words minus words of the training": ("held_out", "training"),
        "words of another task minus words of the training": ("another_task", "training"),
    }
    lines = []
    for title, (more, less) in pairs.items():
        gaps = [a - b for a, b in zip(means(rows, more), means(rows, less), strict=True)]
        lines.append([title, interval(gaps)])
    return markdown(["difference", "success"], lines)


def means(rows: Sequence[Row], key: str) -> list[float]:
    """For each seed, the mean over its tasks."""
    seeds = dict.fromkeys(row["seed"] for row in rows)
    return [statistics.mean(row[key] for row in rows if row["seed"] == seed) for seed in seeds]


def render(path: Path) -> str:
    """Both tables, in markdown.

    Raises:
        UserError: the file cannot be read.
    """
    try:
        rows = json.loads(path.read_text("utf-8-sig"))["rows"]
        return f"{successes(rows)}\n\n{differences(rows)}"
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"{path} cannot be read ({error}); write it again with `python -m tools.words`"
        ) from None


def main(arguments: Sequence[str]) -> int:
    """Write docs/words.md; returns the exit code."""
    source = Path(arguments[0]) if arguments else RESULTS
    return write_tables(PAGE, lambda: render(source))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
