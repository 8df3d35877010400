"""Whether the answer depends on what counts as success, or on how the agent acts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from statistics import fmean

from symsteer.leaderboard.known_agents import STANDARD, STRICT
from symsteer.leaderboard.rows import MIN_SEEDS, Summary, Table
from symsteer.leaderboard.runs import Run
from symsteer.leaderboard.sections import Section, View
from symsteer.leaderboard.sections.what_symmetry_gains import kinds
from symsteer.leaderboard.statistics import Interval, Sample, stratified_bootstrap
from symsteer.leaderboard.text import code, difference, number, table_text

EXPLAINED = f"""\
`{STRICT}` minus `{STANDARD}` by other measures of success, mean over the cells of a kind of world,
paired by base policy, with 95 % intervals. *Once*: at any step of the episode; *at the end*: at its
last step. *Stochastic*: the actor with its exploration. All of them are of the final evaluation."""

AT_END = "Success at the end of an episode, of each learner, mean over the cells:"

STOCHASTIC = {
    "once, stochastic": "success_stochastic",
    "at the end, stochastic": "success_at_end_stochastic",
}

MEASURES = ("once", "at the end", *STOCHASTIC)


@dataclass(frozen=True)
class Row:
    """A kind of world.

    Attributes:
        kind: as markdown.
        effects: by measure, those that enough base policies have.
        cells: that any of them rests on.
        at_end: success at the end of an episode, by learner that all cells have.
    """

    kind: str
    effects: dict[str, Interval]
    cells: int
    at_end: dict[str, float]


def measured(run: Run, name: str) -> float | None:
    """A share of successes in a finished run's final evaluation; None if it does not have it."""
    assert run.record.final is not None
    if name == "once":
        return fmean(map(float, run.record.final.episodes.success_once))
    if name == "at the end":
        return fmean(map(float, run.record.final.episodes.success_at_end))
    return run.last(STOCHASTIC[name])


def compute(summary: Summary) -> list[Row]:
    """Kinds without a measure in a cell with enough base policies are left out."""
    rows = []
    for kind, tables in kinds(summary).items():
        cells = {name: [c for t in tables if (c := _pairs(t, name))] for name in MEASURES}
        effects = {name: stratified_bootstrap(each) for name, each in cells.items() if each}
        if effects:
            rows.append(Row(kind, effects, max(map(len, cells.values())), _at_end(tables)))
    return rows


def _at_end(tables: Sequence[Table]) -> dict[str, float]:
    of = partial(measured, name="at the end")
    shared = frozenset.intersection(*(table.decisive for table in tables))
    rows = {agent: [table.row_of(agent) for table in tables] for agent in sorted(shared)}
    return {
        agent: fmean(fmean(row.by_policy(of).values()) for row in of_agent if row)
        for agent, of_agent in rows.items()
    }


def _pairs(table: Table, name: str) -> list[Sample]:
    rows = table.row_of(STRICT), table.row_of(STANDARD)
    of = partial(measured, name=name)
    strict, plain = (row.by_policy(of) if row else {} for row in rows)
    shared = sorted(strict.keys() & plain.keys())
    if len(shared) < MIN_SEEDS:
        return []
    return [Sample.constant(strict[policy] - plain[policy], policy) for policy in shared]


def render(rows: list[Row], view: View) -> list[str]:
    """A row for each kind of world, a column for each measure that any of them has."""
    shown = [
        {"World": row.kind}
        | {name: difference(each) for name, each in row.effects.items()}
        | {"Cells": str(row.cells)}
        for row in rows
    ]
    agents = [a for a in view.summary.agents if any(a in row.at_end for row in rows)]
    ends = [
        {"World": row.kind}
        | {code(agent): number(row.at_end[agent]) for agent in agents if agent in row.at_end}
        for row in rows
        if row.at_end
    ]
    told = [AT_END, table_text(ends, sparse=True)] if ends else []
    return [EXPLAINED, table_text(shown, sparse=True), *told] if shown else []


SECTION = Section("Other measures of success", lambda findings: compute(findings.summary), render)
