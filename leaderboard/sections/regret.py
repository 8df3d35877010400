"""Regret: what an agent loses against the best learner of each cell."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from symsteer.leaderboard.cell_names import cell_name
from symsteer.leaderboard.figures import by_rows, look_of
from symsteer.leaderboard.known_agents import STANDARD
from symsteer.leaderboard.plots import Axis, Dot, Figure
from symsteer.leaderboard.regret import (
    Cell,
    Values,
    intervals,
    of_an_agent_without_regret,
    regrets,
)
from symsteer.leaderboard.rows import MIN_SEEDS, Summary, Table
from symsteer.leaderboard.sections import Section, View
from symsteer.leaderboard.statistics import Interval
from symsteer.leaderboard.study import Safe
from symsteer.leaderboard.text import code, count, folded, interval, number, table_text

EXPLAINED = """\
What a learner loses against the best learner of the same cell (one world, one budget), on average
and in its worst cell: the price of taking it without knowing the world. In brackets: 95 %
intervals."""

HOW = f"""\
The best learner of a cell, and the worst cell of a learner, are chosen on one half of the base
policies and measured on the other half, so that luck does not count. Such a regret may be negative.
The cells are those in which all these learners have {MIN_SEEDS} base policies. The last row is an
agent that loses nothing, simulated with the scatter of these cells. The cell that is named is the
one with the largest regret. Intervals: [jackknife](https://doi.org/10.1214/aos/1176345462) over
base policies."""

PICTURE = """\
The largest loss in the picture may exceed *worst* in the table: the table chooses the worst cell
on other base policies than those on which it measures."""

MEASURES = ("success", "area")


@dataclass(frozen=True)
class Regret:
    """Of each learner in each cell.

    Attributes:
        learners: names.
        cells: tables.
        success, area: ``[learners, cells]``.
        mean, worst: over cells, of each measure and learner.
        nothing: of an agent without regret, success and area: mean and worst, over repetitions.
    """

    learners: list[str]
    cells: list[Table]
    success: Values
    area: Values
    mean: dict[str, list[Interval]]
    worst: dict[str, list[Interval]]
    nothing: dict[str, tuple[float, float]]


def compute(summary: Summary, without: Collection[str] = ()) -> Regret | None:
    """Of cells of any budget, of tasks not in ``without``; None if no two learners share one."""
    tables = [table for table in summary.tables if table.key.task not in without]
    learners = {id(table): table.decisive for table in tables}
    counts = Counter(names for names in learners.values() if len(names) > 1)
    if not counts:
        return None
    # The learners that most cells have.
    wanted = max(counts, key=lambda names: (counts[names], len(names)))
    names = [agent for agent in summary.agents if agent in wanted]
    cells: list[Table] = []
    values: dict[str, list[Cell]] = {measure: [] for measure in MEASURES}
    for table in tables:
        each = [_values(table, names, m) for m in MEASURES] if wanted <= learners[id(table)] else []
        if each and len(each[0].policies) >= MIN_SEEDS:
            cells.append(table)
            for measure, of_policies in zip(MEASURES, each, strict=True):
                values[measure].append(of_policies)
    if not cells:
        return None
    each_cell, mean, worst, nothing = {}, {}, {}, {}
    for measure, of_cells in values.items():
        each_cell[measure] = regrets(of_cells).cells
        mean[measure], worst[measure] = intervals(of_cells)
        of_nothing = of_an_agent_without_regret(of_cells)
        nothing[measure] = float(of_nothing[0].mean()), float(of_nothing[1].mean())
    return Regret(names, cells, each_cell["success"], each_cell["area"], mean, worst, nothing)


def _values(table: Table, learners: list[str], measure: str) -> Cell:
    rows = [row for agent in learners if (row := table.row_of(agent))]
    by_policy = [row.by_policy(measure) for row in rows]
    shared = sorted(set.intersection(*map(set, by_policy)))
    values = [[values[policy] for policy in shared] for values in by_policy]
    return Cell(np.array(values), shared, table.key.place)


def render(regret: Regret | None, view: View) -> list[str]:
    """The verdict on a declared agent, the table (the smallest worst regret of success first), the
    picture."""
    if regret is None:
        return []
    order = np.argsort([each.value for each in regret.worst["success"]], kind="stable")
    rows = [
        {"Learner": code(regret.learners[i])}
        | _columns({m: (regret.mean[m][i], regret.worst[m][i]) for m in MEASURES})
        | {
            "Worst cell by success": cell_name(
                regret.cells[regret.success[i].argmax()], view.summary
            )
        }
        for i in order
    ]
    last = {"Learner": "*without regret*"} | _columns(regret.nothing)
    safe = view.findings.study.safe
    return [
        f"{EXPLAINED} Cells: {len(regret.cells)}, of {_budgets(regret.cells)} steps.",
        *([verdict(regret, safe, view.summary)] if safe else []),
        table_text([*rows, last], sparse=True),
        *view.drawn(kind="regret"),
        PICTURE,
        *folded("How it is measured", [HOW]),
    ]


def _budgets(tables: Sequence[Table]) -> str:
    return " and ".join(map(count, sorted({table.key.env_steps for table in tables})))


def verdict(regret: Regret, safe: Safe, summary: Summary) -> str:
    """Whether the agent that is declared safe is so, in both measures."""
    allowed = f"{number(safe.success)} of success and {number(safe.area)} of area"
    declared = (
        f"Declared before the runs: in its worst cell {code(safe.agent)} loses at most {allowed} "
        "more than an agent without regret, and less than every other learner."
    )
    everywhere = _judged(regret, safe)
    if not safe.tested_on:
        return f"{declared} {everywhere}"
    known = ", ".join(map(code, safe.tested_on))
    new = _judged(compute(summary, safe.tested_on), safe)
    in_all = everywhere.replace("**", "")
    return f"{declared} Without {known}, where it was tested before: {new} In all: {in_all}"


@dataclass(frozen=True)
class Standing:
    """The worst regret of an agent, by one measure, above that of an agent without regret.

    Attributes:
        above: of the agent.
        best: the learner of all others that is least above.
        least: of this one.
        holds: the agent is above by no more than it may be, and by less than every other learner.
    """

    above: float
    best: str
    least: float
    holds: bool


def standings(regret: Regret, safe: Safe) -> dict[str, Standing]:
    """Of the safe agent, which must be one of the learners, by measure."""
    found = {}
    for measure, most in (("success", safe.success), ("area", safe.area)):
        nothing = regret.nothing[measure][1]
        values = [each.value - nothing for each in regret.worst[measure]]
        worst = dict(zip(regret.learners, values, strict=True))
        above = worst.pop(safe.agent)
        best = min(worst, key=lambda agent: worst[agent])
        found[measure] = Standing(above, best, worst[best], above <= most and above < worst[best])
    return found


def fallback(summary: Summary, safe: Safe | None) -> str:
    """What to take where nothing is known: the agent that was declared safe and is, else plain."""
    if safe is None:
        return STANDARD
    regret = compute(summary, safe.tested_on)
    if regret is None or safe.agent not in regret.learners:
        return STANDARD
    proven = all(each.holds for each in standings(regret, safe).values())
    return safe.agent if proven else STANDARD


def _judged(regret: Regret | None, safe: Safe) -> str:
    if regret is None:
        return "**Not tested**: there is no cell that two learners share."
    if safe.agent not in regret.learners:
        return "**Not tested**: it is not in all of these cells."
    found = standings(regret, safe)
    texts = [
        f"{number(each.above, 3, sign=True)} of {measure} ({code(each.best)}, the best of the "
        f"others: {number(each.least, 3, sign=True)})"
        for measure, each in found.items()
    ]
    result = "Supported" if all(each.holds for each in found.values()) else "Contradicted"
    return f"**{result}**: above an agent without regret by {' and '.join(texts)}."


def _columns(of: Mapping[str, tuple[Interval | float, Interval | float]]) -> dict[str, str]:
    """By measure: mean and worst."""
    return {
        f"{measure}: {name}": interval(value) if isinstance(value, Interval) else number(value)
        for measure, both in of.items()
        for name, value in zip(("mean", "worst"), both, strict=True)
    }


def figure(regret: Regret, summary: Summary) -> Figure:
    """The regret of every learner in every cell."""
    columns = {
        f"regret of {name}": [
            Dot(agent, Interval(value, value, value), row, look_of(agent), text=f"{value:.3f}")
            for agent, values in zip(regret.learners, getattr(regret, measure), strict=True)
            for row, value in enumerate(map(float, values))
        ]
        for measure, name in (("success", "success"), ("area", "area under the curve"))
    }
    labels = [cell_name(table, summary).replace("`", "") for table in regret.cells]
    return replace(
        by_rows(labels, columns, Axis("below the best learner of the cell"), undecided=0.0),
        legend={agent: replace(look_of(agent), dash="none") for agent in regret.learners},
        height=1.4 + 0.25 * len(labels),
        kind="regret",
        text="What each learner loses against the best one of each cell",
    )


SECTION = Section(
    "What a wrong choice costs",
    lambda findings: compute(findings.summary),
    render,
    where="first",
    figures=lambda regret, summary: [figure(regret, summary)] if regret else [],
)
