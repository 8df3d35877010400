"""Writes the tables of docs/words.md.

python -m tools.pages.words           # from leaderboard/results/words
python -m tools.pages.words FOLDER    # from words.json, which `python -m tools.words` writes, and
                                      # from the records in `records`, both in a folder
"""

from __future__ import annotations

import json
import statistics
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from symsteer.errors import UserError
from symsteer.leaderboard.paths import RESULTS
from symsteer.leaderboard.runs import load_runs
from symsteer.tables import markdown
from tools.pages.marks import CHECKOUT, write_tables
from tools.pages.minima import interval, spread
from tools.pages.steered import steering

PAGE = CHECKOUT / "docs" / "words.md"

Row = Mapping[str, Any]

SHOWN = {
    "`edp-joint`, one-hot": "one_hot",
    "`edp-told`, words of the training": "training",
    "held-out words": "held_out",
    "of these, with a new verb": "new_verb",
    "words of another task": "another_task",
}

NEW_VERB = 2
"""Every third held-out wording has a verb that no wording of the training has."""


def read(path: Path) -> list[Row]:
    """The rows of a file, with the mean over the sentences of each kind.

    Raises:
        UserError: a task lacks a training, or there are fewer than two trainings.
    """
    found = json.loads(path.read_text("utf-8-sig"))["rows"]
    seeds, tasks = ({row[key] for row in found} for key in ("seed", "task"))
    if len(seeds) < 2 or len(found) != len(seeds) * len(tasks):
        raise UserError(f"{path} is not finished; go on with `python -m tools.words`")
    rows: list[Row] = []
    for row in found:
        shares = {name: row[name] for name in SHOWN.values() if name in row}
        shares |= {
            "new_verb": row["held_out"][NEW_VERB::3],
            # In the same episodes, since a sentence has episodes of its own.
            "beside_new_verb": row["training"][NEW_VERB::3],
        }
        means_of = {name: statistics.mean(each) for name, each in shares.items()}
        rows.append({"seed": row["seed"], "task": row["task"], **means_of})
    return rows


def successes(rows: Sequence[Row]) -> str:
    """By task, mean [lowest, highest] over the seeds."""
    lines = []
    for task in dict.fromkeys(row["task"] for row in rows):
        found = [row for row in rows if row["task"] == task]
        lines.append([task, *(spread([row[key] for row in found]) for key in SHOWN.values())])
    every = [spread(means(rows, key)) for key in SHOWN.values()]
    return markdown(["task", *SHOWN], [*lines, ["mean of the tasks", *every]])


def differences(rows: Sequence[Row]) -> str:
    """Of the means over the tasks, with 95 and 90 % intervals over the seeds."""
    pairs = {
        "words of the training minus one-hot": ("training", "one_hot"),
        "held-out words minus words of the training": ("held_out", "training"),
        "those with a new verb, in the same episodes": ("new_verb", "beside_new_verb"),
        "words of another task minus words of the training": ("another_task", "training"),
    }
    lines = []
    for title, (more, less) in pairs.items():
        gaps = [a - b for a, b in zip(means(rows, more), means(rows, less), strict=True)]
        lines.append([title, interval(gaps), interval(gaps, 0.9)])
    return markdown(["difference", "success, 95 % interval", "90 % interval"], lines)


def means(rows: Sequence[Row], key: str) -> list[float]:
    """For each seed, the mean over its tasks."""
    seeds = dict.fromkeys(row["seed"] for row in rows)
    return [statistics.mean(row[key] for row in rows if row["seed"] == seed) for seed in seeds]


def render(folder: Path) -> str:
    """All tables, in markdown.

    Raises:
        UserError: the file, or a record, cannot be read.
    """
    path = folder / "words.json"
    try:
        rows = read(path)
        tables = successes(rows), differences(rows), steering(load_runs([folder / "records"]))
        return "\n\n".join(tables)
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"{path} cannot be read ({error}); write it again with `python -m tools.words`"
        ) from None


def main(arguments: Sequence[str]) -> int:
    """Write docs/words.md; returns the exit code."""
    folder = Path(arguments[0]) if arguments else RESULTS / "words"
    return write_tables(PAGE, lambda: render(folder))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
