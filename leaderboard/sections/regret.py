"""Regret: what an agent loses against the best learner of each cell."""

from __future__ import annotations

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
    by_cell = [(table, _common(table)) for table in summary.usual_tables]
    counts: dict[frozenset[str], int] = {}
    for _, (learners, _) in by_cell:
        counts[learners] = counts.get(learners, 0) + 1
    # The learners that most cells have.
    wanted = max(
        counts, key=lambda names: (counts[names] * (len(names) > 1), len(names)), default=()
    )
    if len(wanted) < 2:
        return None
    names = [agent for agent in summary.agents if agent in wanted]
    chosen = [table for table, (learners, _) in by_cell if learners >= frozenset(wanted)]
    measured, nothing = {}, {}
    for measure in ("success", "area"):
        values = [_values(table, names, measure) for table in chosen]
        measured[measure] = np.array([regrets(each) for each in values]).T
        draws = of_an_agent_without_regret(values)
        nothing[measure] = float(draws.mean()), float(draws.max(1).mean())
    return Regret(names, chosen, measured["success"], measured["area"], nothing)


def _common(table: Table) -> tuple[frozenset[str], set[str]]:
    """The learners of a cell with enough base policies in common, and these."""
    rows = {row.agent: table.row_of(row.agent) for row in table.learners if row.role == "learner"}
    policies = {agent: {run.policy for run in row.finished} for agent, row in rows.items() if row}
    enough = {agent: found for agent, found in policies.items() if len(found) >= MIN_SEEDS}
    shared = set.intersection(*enough.values()) if enough else set()
    return (frozenset(enough), shared) if len(shared) >= MIN_SEEDS else (frozenset(), set())


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
