"""Regret: what an agent loses against the best learner of each cell."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from symsteer.leaderboard.cell_names import cell_name
from symsteer.leaderboard.regret import Values, of_an_agent_without_regret, regrets
from symsteer.leaderboard.rows import MIN_SEEDS, Summary, Table
from symsteer.leaderboard.sections import Section, View
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
    """The table, the smallest worst regret of success first."""
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
    return [f"{EXPLAINED} Cells: {len(regret.cells)}.", table_text([*rows, last], sparse=True)]


def _columns(measure: str, mean: float, worst: float) -> dict[str, str]:
    return {f"{measure}: mean": number(mean, 3), f"{measure}: worst": number(worst)}


SECTION = Section("Regret", lambda findings: compute(findings.summary), render)
