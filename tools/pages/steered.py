"""Writes the tables of docs/tasks/clutter-pick.md: how agents steer the base policies of a task.

python -m tools.pages.steered        # from leaderboard/results/clutter
python -m tools.pages.steered RUNS   # from other runs, a folder or a record each
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from symsteer.errors import UserError
from symsteer.leaderboard.known_agents import BASE, STANDARD, STRICT
from symsteer.leaderboard.pairs import advantage
from symsteer.leaderboard.paths import RESULTS
from symsteer.leaderboard.row_numbers import summarize
from symsteer.leaderboard.runs import Run, load_runs
from symsteer.leaderboard.text import code
from symsteer.tables import markdown
from tools.pages.marks import CHECKOUT, write_tables
from tools.pages.minima import interval, spread

PAGE = CHECKOUT / "docs" / "tasks" / "clutter-pick.md"
RECORDS = RESULTS / "clutter"

ZERO = "zero"
LEARNERS = (STANDARD, STRICT, "residual-pathway")

PAIRS = (
    (STRICT, STANDARD),
    ("residual-pathway", STRICT),
    *((learner, reference) for reference in (BASE, ZERO) for learner in LEARNERS),
)
"""Agents whose differences are shown."""


def steering(runs: Sequence[Run]) -> str:
    """Two tables: success of each agent in the last fifth of the steps, and differences of pairs.

    Raises:
        UserError: if the runs are of several kinds, or one is missing.
    """
    summary = summarize(runs)
    if len(summary.tables) != 1 or summary.set_aside:
        raise UserError("runs of one task and world are needed, each of them once")
    (table,) = summary.tables
    agents = [BASE, ZERO, *LEARNERS]
    rows = {row.agent: row.by_policy("success") for row in table.rows}
    policies = set().union(*rows.values())
    if len(policies) < 2 or any(rows.get(agent, {}).keys() != policies for agent in agents):
        raise UserError(
            f"finished runs of {', '.join(agents)} are needed, on the same base policies, two or "
            "more; go on with the sweep"
        )
    reached = [
        [code(agent), spread(list(rows[agent].values())), str(len(policies))] for agent in agents
    ]
    gaps = []
    for first, second in PAIRS:
        pairs = advantage(table, first, second, "success")
        values = [sample.value for sample in pairs.values()]
        gaps.append([f"{code(first)} minus {code(second)}", interval(values), str(len(values))])
    return "\n\n".join(
        (
            markdown(["agent", "success [lowest, highest]", "base policies"], reached),
            markdown(["difference", "success, 95 % interval", "pairs"], gaps),
        )
    )


def main(arguments: Sequence[str]) -> int:
    """Write the tables."""
    places = [Path(argument) for argument in arguments] or [RECORDS]
    return write_tables(PAGE, lambda: steering(load_runs(places)))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
