"""Regret: what an agent loses against the best learner of each cell."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, replace

import numpy as np

from symsteer.leaderboard.cell_names import cell_name
from symsteer.leaderboard.figures import by_rows, look_of
from symsteer.leaderboard.plots import Axis, Dot, Figure
from symsteer.leaderboard.regret import Values, of_an_agent_without_regret, regrets
from symsteer.leaderboard.rows import MIN_SEEDS, Summary, Table
from symsteer.leaderboard.sections import Section, View
from symsteer.leaderboard.statistics import Interval
from symsteer.leaderboard.study import Safe
from symsteer.leaderboard.text import code, number, table_text

EXPLAINED = f"""\
How much a learner is below the best learner of a cell, on average and in its worst cell: what one
loses by taking it without knowing the world. The best learner is chosen on one half of the base
policies and measured on the other, so that luck does not count; a regret may be negative. The cells
are those in which all these learners have {MIN_SEEDS} base policies. The last row is an agent that
loses nothing, simulated with the scatter of these cells: its worst cell is bad luck alone."""


MEASURES = ("success", "area")


@dataclass(frozen=True)
class Regret:
    """Of each learner in each cell.

    Attributes:
        learners: names.
        cells: tables.
        success, area: ``[learners, cells]``.
        nothing: of an agent without regret, success and area: mean and worst, over repetitions.
    """

    learners: list[str]
    cells: list[Table]
    success: Values
    area: Values
    nothing: dict[str, tuple[float, float]]


def compute(summary: Summary) -> Regret | None:
    """None if no two learners share a cell."""
    learners = {id(table): _learners(table) for table in summary.usual_tables}
    counts = Counter(names for names in learners.values() if len(names) > 1)
    if not counts:
        return None
    # The learners that most cells have.
    wanted = max(counts, key=lambda names: (counts[names], len(names)))
    names = [agent for agent in summary.agents if agent in wanted]
    cells: list[Table] = []
    values: dict[str, list[Values]] = {measure: [] for measure in MEASURES}
    for table in summary.usual_tables:
        each = [_values(table, names, m) for m in MEASURES] if wanted <= learners[id(table)] else []
        if each and each[0].shape[1] >= MIN_SEEDS:
            cells.append(table)
            for measure, of_policies in zip(MEASURES, each, strict=True):
                values[measure].append(of_policies)
    if not cells:
        return None
    measured = {
        measure: np.array([regrets(each) for each in values[measure]]).T for measure in MEASURES
    }
    nothing = {}
    for measure in MEASURES:
        draws = of_an_agent_without_regret(values[measure])
        nothing[measure] = float(draws.mean()), float(draws.max(1).mean())
    return Regret(names, cells, **measured, nothing=nothing)


def _learners(table: Table) -> frozenset[str]:
    """The learners of a cell with enough base policies."""
    rows = [table.row_of(row.agent) for row in table.learners if row.role == "learner"]
    policies = {row.agent: {run.policy for run in row.finished} for row in rows if row}
    return frozenset(agent for agent, hashes in policies.items() if len(hashes) >= MIN_SEEDS)


def _values(table: Table, learners: list[str], measure: str) -> Values:
    by_policy: dict[str, dict[str, list[float]]] = {agent: {} for agent in learners}
    for agent, of_policy in by_policy.items():
        row = table.row_of(agent)
        for run in row.finished if row else ():
            of_policy.setdefault(run.policy, []).append(getattr(run, measure))
    shared = sorted(set.intersection(*map(set, by_policy.values())))
    return np.array([[np.mean(by_policy[a][policy]) for policy in shared] for a in learners])


def render(regret: Regret | None, view: View) -> list[str]:
    """The verdict on a declared agent, the picture, and the table, the smallest worst regret of
    success first."""
    if regret is None:
        return []
    order = regret.success.max(1).argsort(kind="stable")
    rows = [
        {"Learner": code(regret.learners[i])}
        | _columns("success", regret.success[i].mean(), regret.success[i].max())
        | _columns("area", regret.area[i].mean(), regret.area[i].max())
        | {
            "Worst cell by success": cell_name(
                regret.cells[regret.success[i].argmax()], view.summary
            )
        }
        for i in order
    ]
    last = {"Learner": "*without regret*"}
    for measure, (mean, worst) in regret.nothing.items():
        last |= _columns(measure, mean, worst)
    safe = view.findings.study.safe
    return [
        f"{EXPLAINED} Cells: {len(regret.cells)}.",
        *([verdict(regret, safe)] if safe else []),
        *view.drawn(kind="regret"),
        table_text([*rows, last], sparse=True),
    ]


def verdict(regret: Regret, safe: Safe) -> str:
    """Whether the agent that is declared safe is so, in both measures."""
    allowed = f"{number(safe.success)} of success and {number(safe.area)} of area"
    declared = (
        f"Declared before the runs: in its worst cell {code(safe.agent)} loses at most {allowed} "
        "more than an agent without regret, and less than every other learner."
    )
    if safe.agent not in regret.learners:
        return f"{declared} **Not tested**: it is not in all of these cells."
    holds, texts = [], []
    for measure, most in (("success", safe.success), ("area", safe.area)):
        worst = dict(zip(regret.learners, getattr(regret, measure).max(1), strict=True))
        above = worst.pop(safe.agent) - regret.nothing[measure][1]
        best = min(worst, key=lambda agent: worst[agent])
        least = worst[best] - regret.nothing[measure][1]
        holds.append(above <= most and above < least)
        texts.append(
            f"{number(above, 3, sign=True)} of {measure} ({code(best)}, the best of the others: "
            f"{number(least, 3, sign=True)})"
        )
    result = "Supported" if all(holds) else "Contradicted"
    return f"{declared} **{result}**: above an agent without regret by {' and '.join(texts)}."


def _columns(measure: str, mean: float, worst: float) -> dict[str, str]:
    return {f"{measure}: mean": number(mean, 3), f"{measure}: worst": number(worst)}


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
    "Regret",
    lambda findings: compute(findings.summary),
    render,
    figures=lambda regret, summary: [figure(regret, summary)] if regret else [],
)
