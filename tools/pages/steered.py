"""Writes the table of docs/tasks/clutter-pick.md: how agents steer the base policies of a task.

python -m tools.pages.steered        # from leaderboard/results/clutter
python -m tools.pages.steered RUNS   # from other runs, a folder or a record each
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from symsteer.leaderboard.known_agents import STANDARD, STRICT
from symsteer.leaderboard.pairs import compare
from symsteer.leaderboard.paths import RESULTS
from symsteer.leaderboard.row_numbers import summarize
from symsteer.leaderboard.rows import Table
from symsteer.leaderboard.runs import Run, load_runs
from symsteer.leaderboard.statistics import Interval
from symsteer.leaderboard.text import code, difference, interval
from symsteer.tables import markdown
from tools.pages.marks import CHECKOUT, write_tables

PAGE = CHECKOUT / "docs" / "tasks" / "clutter-pick.md"
RECORDS = RESULTS / "clutter"

PAIRS = ((STRICT, STANDARD), ("residual-pathway", STRICT))
"""Agents whose differences are shown."""


def steering(runs: Sequence[Run]) -> str:
    """Two tables, a row for each task, policy and world: success by agent, and differences.

    Success is that of the last fifth of the steps, with 95 % intervals over base policies and
    episodes.
    """
    summary = summarize(runs)
    agents, tables = summary.agents, summary.tables
    reached = [[*_place(t), *(interval(_success(t, a)) for a in agents)] for t in tables]
    gaps = [[*_place(t), *(_gap(t, *pair) for pair in PAIRS)] for t in tables]
    heads = ["task", "policy", "world", "base policies"]
    titles = [f"{code(first)} minus {code(second)}" for first, second in PAIRS]
    return "\n\n".join(
        (
            markdown([*heads, *map(code, agents)], reached, left=3),
            markdown([*heads, *titles], gaps, left=3),
        )
    )


def _place(table: Table) -> list[str]:
    policies = {run.policy for run in table.counted if run.finished}
    return [*map(code, (table.key.task, table.key.base, table.key.variant)), str(len(policies))]


def _success(table: Table, agent: str) -> Interval | None:
    row = table.row_of(agent)
    return row.success if row else None


def _gap(table: Table, first: str, second: str) -> str:
    one, two = table.row_of(first), table.row_of(second)
    return difference(compare(one, two) if one and two else None)


def main(arguments: Sequence[str]) -> int:
    """Write the table."""
    places = [Path(argument) for argument in arguments] or [RECORDS]
    return write_tables(PAGE, lambda: steering(load_runs(places)))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
