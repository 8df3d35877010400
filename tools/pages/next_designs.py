"""Writes a table of docs/between.md: do the next designs meet the criterion of a safe agent?

python -m tools.pages.next_designs            # from the committed records
python -m tools.pages.next_designs RUNS...    # from other records, a folder or a record each

Each design is judged beside the learners of the suite dial, without the other designs, by what the
claims of that suite ask of the agent that they call safe: in all its worlds, and without the one in
which the designs were chosen.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from symsteer.errors import UserError
from symsteer.leaderboard.paths import RESULTS
from symsteer.leaderboard.row_numbers import summarize
from symsteer.leaderboard.runs import Run, load_runs
from symsteer.leaderboard.sections.regret import MEASURES, compute, standings
from symsteer.leaderboard.study import Safe, read_study
from symsteer.leaderboard.text import code, interval, number
from symsteer.tables import markdown
from tools.pages.marks import CHECKOUT, write_tables

PAGE = CHECKOUT / "docs" / "between.md"
RECORDS = RESULTS / "dial", RESULTS / "dial-next"

DESIGNS = ("slow", "free-bias")
"""Those that went on to all worlds."""

DROPPED = ("screened",)
"""Those that did not."""

CHOSEN_IN = ("PickCube-v1", "actuator_offset:0.5")
"""Task and variant of the world in which they were chosen."""

STUDY = read_study("dial")


def render(runs: Sequence[Run]) -> str:
    """Rows of each design, and of the agent that the suite dial tested.

    Raises:
        UserError: a design lacks a run of the suite dial.
    """
    safe = STUDY.safe
    assert safe
    for design in DESIGNS:
        if missing := _settings(runs, safe.agent) - _settings(runs, design):
            raise UserError(f"{design} lacks {len(missing)} runs; finish the suite dial-next")
    agents = [safe.model_copy(update={"agent": name}) for name in (*DESIGNS, safe.agent)]
    elsewhere = [run for run in runs if _world(run) != CHOSEN_IN]
    rows = [row for part in (runs, elsewhere) for agent in agents for row in _rows(part, agent)]
    heads = ["learner", "worlds", "by", "mean", "worst", "above none", "others", "holds"]
    return markdown(heads, rows, left=1)


def _world(run: Run) -> tuple[str, str]:
    return run.record.settings.task, run.record.settings.variant


def _settings(runs: Sequence[Run], agent: str) -> set[tuple[str, str, int, int]]:
    """World, budget and base policy of an agent's finished runs."""
    own = [run for run in runs if run.agent == agent and run.finished]
    return {(*_world(run), run.record.settings.env_steps, run.seed) for run in own}


def _rows(runs: Sequence[Run], safe: Safe) -> list[list[str]]:
    """How the agent does beside the learners of the suite dial, by each measure."""
    others = {*DESIGNS, *DROPPED} - {safe.agent}
    regret = compute(summarize([run for run in runs if run.agent not in others]))
    assert regret
    found, place, rows = standings(regret, safe), regret.learners.index(safe.agent), []
    for measure in MEASURES:
        each = found[measure]
        cells = [interval(of[measure][place]) for of in (regret.mean, regret.worst)]
        cells += [number(each.above, 3), number(each.least, 3), "yes" if each.holds else "no"]
        rows.append([code(safe.agent), str(len(regret.cells)), measure, *cells])
    return rows


def main(arguments: Sequence[str]) -> int:
    """Write the table."""
    places = [Path(argument) for argument in arguments] or RECORDS
    return write_tables(PAGE, lambda: render(load_runs(places, area_from=STUDY.area_from)))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
