"""Writes the tables of docs/words.md.

python -m tools.pages.words           # from leaderboard/results/words
python -m tools.pages.words FOLDER    # from words.json, which `python -m tools.words` writes, and
                                      # from the records in `records`, both in a folder
"""

from __future__ import annotations

import itertools
import json
import statistics
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from symsteer.errors import UserError
from symsteer.leaderboard.known_agents import row_place
from symsteer.leaderboard.paths import RESULTS
from symsteer.leaderboard.runs import Run, load_runs
from symsteer.leaderboard.text import code
from symsteer.tables import markdown
from tools.pages.marks import CHECKOUT, write_tables
from tools.pages.minima import interval, spread

PAGE = CHECKOUT / "docs" / "words.md"

Row = Mapping[str, Any]

SHOWN = {
    "`edp-joint`, one-hot": "one_hot",
    "`edp-told`, words of the training": "training",
    "held-out words": "held_out",
    "of these, with a new verb": "new_verb",
    "words of another task": "another_task",
}

KINDS = ("edp-joint", "edp-told")

INTERVALS = ("success, 95 % interval", "90 % interval")

NEW_VERB = 2
"""Every third held-out wording has a verb that no wording of the training has."""


def read(path: Path) -> list[Row]:
    """The rows of a file, with the mean over the sentences of each kind.

    Raises:
        UserError: a task lacks a training.
    """
    file = json.loads(path.read_text("utf-8-sig"))
    found = file["rows"]
    planned = {(seed, task) for seed in file["seeds"] for task in file["tasks"]}
    if {(row["seed"], row["task"]) for row in found} != planned:
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
    return markdown(["difference of the means over the tasks", *INTERVALS], lines)


def steered(runs: Sequence[Run]) -> str:
    """Two tables: success of the final evaluation by agent, and how much higher `edp-told` is.

    Raises:
        UserError: an agent lacks a run that others have, or a run is not finished.
    """
    finished = [run for run in runs if run.finished]
    reached = {
        (run.record.settings.task, run.record.base_policy.name, run.agent, run.seed): (
            statistics.mean(run.final_success.values())
        )
        for run in finished
    }
    tasks = sorted({run.record.settings.task for run in runs})
    roles = {run.agent: run.record.role for run in runs}
    agents = sorted(roles, key=lambda agent: row_place(agent, roles[agent]))
    seeds = sorted({run.seed for run in runs})
    planned = itertools.product(tasks, KINDS, agents, seeds)
    if not reached or set(planned) != reached.keys() or len(runs) != len(reached):
        raise UserError(
            "the runs of the suite words are not all there, each of them once; go on with the sweep"
        )
    lines = [
        [task, code(kind), *(spread([reached[task, kind, a, s] for s in seeds]) for a in agents)]
        for task in tasks
        for kind in KINDS
    ]
    gaps = []
    for agent in agents:
        one_hot, told = (
            [statistics.mean(reached[task, kind, agent, seed] for task in tasks) for seed in seeds]
            for kind in KINDS
        )
        gap = [a - b for a, b in zip(told, one_hot, strict=True)]
        gaps.append([code(agent), interval(gap), interval(gap, 0.9)])
    heads = ["`edp-told` minus `edp-joint`, mean of the tasks", *INTERVALS]
    named = ["task", "policy", *map(code, agents)]
    return f"{markdown(named, lines, left=2)}\n\n{markdown(heads, gaps)}"


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
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"{path} cannot be read ({error}); write it again with `python -m tools.words`"
        ) from None
    trainings = len({row["seed"] for row in rows})
    runs = load_runs([folder / "records"])
    policies = len({run.seed for run in runs})
    return "\n\n".join(
        (
            f"**Without steering**, {trainings} trainings of each: mean [lowest, highest].",
            successes(rows),
            differences(rows),
            f"**Steered**, {policies} policies of each: mean [lowest, highest].",
            steered(runs),
        )
    )


def main(arguments: Sequence[str]) -> int:
    """Write docs/words.md; returns the exit code."""
    folder = Path(arguments[0]) if arguments else RESULTS / "words"
    return write_tables(PAGE, lambda: render(folder))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
