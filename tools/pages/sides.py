"""Writes the table of docs/advise.md: how often a test of decisions finds a break.

python -m tools.pages.sides          # from the committed records
python -m tools.pages.sides RUNS...  # from other runs of base, a folder or a record each
"""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from symsteer.errors import UserError
from symsteer.leaderboard.paths import record_files
from symsteer.leaderboard.records import RunRecord, read_record
from symsteer.tables import markdown
from tools.pages.marks import CHECKOUT, write_tables

PAGE = CHECKOUT / "docs" / "advise.md"
RESULTS = CHECKOUT / "leaderboard" / "results"
RECORDS = RESULTS / "strengths", RESULTS / "dial"

LEVEL = 0.01
"""A side is found if the p-value is at most this, as in the rule."""


def render(records: Sequence[RunRecord]) -> str:
    """Shares of runs, by embodiment and break; the drift in centimetres, mean over runs."""
    found: dict[tuple[str, str], dict[tuple[str, ...], dict[str, float]]] = defaultdict(dict)
    for record in records:
        config = record.settings
        last = record.evaluations[-1].diagnostics if record.evaluations else {}
        if config.agent != "base" or record.status != "finished" or "drift_x" not in last:
            continue
        values = {name: value for name in last if (value := last[name]) is not None}
        # A longer budget has the same episodes.
        policy = config.task, str(config.seed), str(config.demonstrations.count)
        found[config.embodiment, config.variant][policy] = values
    if not found:
        raise UserError("no finished run of base has the test of sides; run the suite strengths")
    rows = []
    for world, by_policy in sorted(found.items()):
        runs, tasks = list(by_policy.values()), {task for task, *_ in by_policy}
        share = {
            name: np.mean([run[name] <= LEVEL for run in runs])
            for name in ("direction_p", "axis_p")
        }
        drift = 100 * np.mean([abs(complex(run["drift_x"], run["drift_y"])) for run in runs])
        cells = [f"{share['direction_p']:.2f}", f"{share['axis_p']:.2f}", f"{drift:.2f}"]
        rows.append([world[0], f"`{world[1]}`", str(len(tasks)), str(len(runs)), *cells])
    heads = ["embodiment", "world", "tasks", "runs", "a direction", "an axis", "drift (cm)"]
    return markdown(heads, rows, left=2)


def main(arguments: Sequence[str]) -> int:
    """Write the table."""
    places = [Path(argument) for argument in arguments] or RECORDS
    return write_tables(PAGE, lambda: render([read_record(p) for p in record_files(places)]))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
