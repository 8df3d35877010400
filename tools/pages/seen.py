"""Writes the tables of docs/seen.md: base policies that see in several ways, and their steering.

python -m tools.pages.seen            # from leaderboard/results/seen
python -m tools.pages.seen RUNS...    # from other runs, a folder or a record each
"""

from __future__ import annotations

import statistics
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from symsteer.leaderboard.known_agents import BASE, STANDARD, STRICT
from symsteer.leaderboard.pairs import advantage
from symsteer.leaderboard.paths import RESULTS
from symsteer.leaderboard.row_numbers import summarize
from symsteer.leaderboard.rows import Table
from symsteer.leaderboard.runs import Pair, Run, load_runs
from symsteer.leaderboard.statistics import Interval, Sample, stratified_bootstrap
from symsteer.leaderboard.text import NOTHING, code, difference, number
from symsteer.tables import markdown
from symsteer.variant import UNBROKEN
from tools.pages.marks import CHECKOUT, write_tables
from tools.pages.minima import spread

PAGE = CHECKOUT / "docs" / "seen.md"
RECORDS = RESULTS / "seen"

WAYS = {"Seen": "a cloud of points", "Height": "heights from above", "Hand": "from the hand"}
"""What a policy sees, by how the names of its tasks begin; else poses."""

APPROXIMATE = "residual-pathway"
LEARNERS = (STANDARD, STRICT, APPROXIMATE)

Cells = Mapping[str, Mapping[Pair, Sample]]
"""Differences of pairs of runs, by task."""


def way_of(task: str) -> str:
    """What a policy sees in a task."""
    return next((way for begin, way in WAYS.items() if task.startswith(begin)), "poses")


def render(runs: Sequence[Run]) -> str:
    """Both tables, in markdown."""
    tables = summarize(runs).tables
    return f"{base_policies(tables)}\n\n{steering(tables)}"


def base_policies(tables: Sequence[Table]) -> str:
    """Of each task: success in held-out episodes, seconds of a training, size."""
    rows = []
    for table in tables:
        row = table.row_of(BASE)
        if table.key.variant != UNBROKEN or row is None:
            continue
        policies = [run.record.base_policy for run in row.finished]
        seconds = [p.training_seconds for p in policies if p.training_seconds is not None]
        rows.append(
            [
                code(table.key.task),
                way_of(table.key.task),
                str(len(policies)),
                spread(list(row.by_policy("success").values())),
                f"{statistics.mean(seconds):.0f}" if seconds else NOTHING,
                f"{policies[0].parameters or 0:,}",
            ]
        )
    heads = ["task", "sees", "trainings", "success", "seconds of a training", "parameters"]
    return markdown(heads, rows, left=2)


def steering(tables: Sequence[Table]) -> str:
    """By what is seen and world, mean over the tasks: success and differences of learners."""
    found: dict[tuple[str, str], list[Table]] = {}
    for table in tables:
        if {*LEARNERS} <= {row.agent for row in table.learners}:
            found.setdefault((way_of(table.key.task), table.key.variant), []).append(table)
    rows = []
    for (way, world), worlds in found.items():
        unbroken = found.get((way, UNBROKEN), [])
        strict = _pairs(worlds, STRICT, STANDARD, "success")
        whole = _pairs(unbroken, STRICT, STANDARD, "success")
        rows.append(
            [
                way,
                code(world),
                *(_success(worlds, agent) for agent in LEARNERS),
                difference(_mean(_pairs(worlds, STRICT, STANDARD, "auc"))),
                difference(_mean(strict)),
                NOTHING if world == UNBROKEN else difference(_mean(_beyond(strict, whole))),
                difference(_mean(_pairs(worlds, APPROXIMATE, STRICT, "success"))),
            ]
        )
    strict_minus = f"{code(STRICT)} minus {code(STANDARD)}"
    heads = ["sees", "world", *map(code, LEARNERS), f"area: {strict_minus}", strict_minus]
    heads += ["less that of the unbroken world", f"{code(APPROXIMATE)} minus {code(STRICT)}"]
    return markdown(heads, rows, left=2)


def _success(tables: Sequence[Table], agent: str) -> str:
    rows = [row for table in tables if (row := table.row_of(agent))]
    return number(statistics.mean(row.success.value for row in rows if row.success))


def _pairs(tables: Sequence[Table], first: str, second: str, measure: str) -> Cells:
    return {table.key.task: advantage(table, first, second, measure) for table in tables}


def _beyond(world: Cells, unbroken: Cells) -> Cells:
    """The difference less that of the unbroken world, on the same base policies."""
    return {
        task: {
            pair: Sample.weighted([sample, unbroken[task][pair]], [1, -1])
            for pair, sample in pairs.items()
            if pair in unbroken.get(task, {})
        }
        for task, pairs in world.items()
    }


def _mean(cells: Cells) -> Interval | None:
    """Over pairs and tasks, with its interval over base policies and episodes."""
    known = [list(pairs.values()) for pairs in cells.values() if pairs]
    return stratified_bootstrap(known) if known else None


def main(arguments: Sequence[str]) -> int:
    """Write the tables."""
    places = [Path(argument) for argument in arguments] or [RECORDS]
    return write_tables(PAGE, lambda: render(load_runs(places)))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
