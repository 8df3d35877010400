"""Writes a table of docs/between.md: are the next designs safe to take?

python -m tools.pages.next_designs            # from the committed records
python -m tools.pages.next_designs RUNS...    # from other records, a folder or a record each

Each design is judged beside the learners of the suite dial, without the other designs, by what the
claims of that suite ask of the agent that they call safe.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from symsteer.errors import UserError
from symsteer.leaderboard.known_agents import BETWEEN
from symsteer.leaderboard.paths import RESULTS
from symsteer.leaderboard.row_numbers import summarize
from symsteer.leaderboard.runs import Run, load_runs
from symsteer.leaderboard.sections.regret import MEASURES, compute, standings
from symsteer.leaderboard.study import read_study
from symsteer.leaderboard.text import code, interval, number
from symsteer.tables import markdown
from tools.pages.marks import CHECKOUT, write_tables

PAGE = CHECKOUT / "docs" / "between.md"
RECORDS = RESULTS / "dial", RESULTS / "dial-next"

DESIGNS = ("slow", "free-bias")
"""Those that went on to all worlds."""

STUDY = read_study("dial")


def render(runs: Sequence[Run]) -> str:
    """A row for each design, and one for the agent that the suite dial tested."""
    safe, rows = STUDY.safe, []
    assert safe
    for design in (*DESIGNS, safe.agent):
        others = {*BETWEEN} - {design}
        regret = compute(summarize([run for run in runs if run.agent not in others]))
        if regret is None or design not in regret.learners:
            raise UserError(f"{design} is not in all worlds of the suite dial; run dial-next")
        found = standings(regret, safe.model_copy(update={"agent": design}))
        place, cells = regret.learners.index(design), []
        for measure in MEASURES:
            each = found[measure]
            cells += [interval(of[measure][place]) for of in (regret.mean, regret.worst)]
            cells.append(f"{number(each.above, 3)} ({number(each.least, 3)})")
        passed = "yes" if all(each.holds for each in found.values()) else "no"
        rows.append([code(design), str(len(regret.cells)), *cells, passed])
    heads = ["mean", "worst", "above an agent without regret (best of the others)"]
    columns = [f"{measure}: {head}" for measure in MEASURES for head in heads]
    return markdown(["learner", "worlds", *columns, "safe"], rows, left=1)


def main(arguments: Sequence[str]) -> int:
    """Write the table."""
    places = [Path(argument) for argument in arguments] or RECORDS
    return write_tables(PAGE, lambda: render(load_runs(places, area_from=STUDY.area_from)))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
