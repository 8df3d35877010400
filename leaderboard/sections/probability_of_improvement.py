"""Probability of improvement: how likely a run of one agent beats a run of another.

As in Agarwal et al. 2021 (arXiv 2108.13264), on the same base policy of the same cell.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

from symsteer.leaderboard.figures import SHARE, by_rows, look_of
from symsteer.leaderboard.known_agents import STANDARD, WITH_SYMMETRY
from symsteer.leaderboard.plots import Axis, Dot, Figure, Look, cut
from symsteer.leaderboard.rows import Summary, Table
from symsteer.leaderboard.sections import Section, View
from symsteer.leaderboard.sections.performance_profiles import (
    TITLE,
    cells_of,
    cells_text,
    group_title,
    groups,
)
from symsteer.leaderboard.statistics import Interval, probability_of_improvement
from symsteer.leaderboard.text import code, interval, table_text

MANY_PAIRS = 28
"""With more pairs of agents, only those with an agent of `AGAINST` are compared."""

AGAINST = (STANDARD, WITH_SYMMETRY[0])

EXPLAINED = (
    "Probability of improvement: how likely a run of X beats a run of Y on the same base policy of "
    "the same cell (ties count half), mean over cells, with 95 % intervals. Of more than "
    f"{MANY_PAIRS} pairs, only those with {' or '.join(map(code, AGAINST))} are shown."
)


@dataclass(frozen=True)
class Improvement:
    """P(a run of `first` beats a run of `second` on one base policy), mean over the tables that
    have both."""

    first: str
    second: str
    cells: int
    runs: tuple[int, int]
    probability: Interval


def improvements(summary: Summary) -> dict[str, list[Improvement]]:
    """By group of tables: every pair of agents that are no references.

    The later one of the page's order comes first. In each table, over the base policies that both
    agents steered. Of more than `MANY_PAIRS` only those with an agent of `AGAINST`.
    """
    learning = [agent for agent, role in summary.roles.items() if role != "reference"]
    pairs = list(combinations(learning, 2))
    if len(pairs) > MANY_PAIRS:
        pairs = [pair for pair in pairs if set(pair) & set(AGAINST)]
    return {
        group: [
            improvement
            for second, first in pairs
            if (improvement := _improvement(first, second, tables))
        ]
        for group, tables in groups(summary).items()
    }


def _improvement(first: str, second: str, tables: Sequence[Table]) -> Improvement | None:
    cells = []
    for table in tables:
        rows = [table.row_of(agent) for agent in (first, second)]
        runs = [[(run.policy, run.success) for run in row.finished] if row else [] for row in rows]
        common = {policy for policy, _ in runs[0]} & {policy for policy, _ in runs[1]}
        if common:
            mine, theirs = ([run for run in of if run[0] in common] for of in runs)
            cells.append((mine, theirs))
    if not cells:
        return None
    return Improvement(
        first,
        second,
        cells=len(cells),
        runs=(sum(len(mine) for mine, _ in cells), sum(len(theirs) for _, theirs in cells)),
        probability=probability_of_improvement(cells),
    )


def render(by_group: dict[str, list[Improvement]], view: View) -> list[str]:
    """The figure, what it means, and its numbers by group of cells; empty without pairs."""
    rows: dict[str, dict[str, str]] = {}
    for group, pairs in by_group.items():
        for pair in pairs:
            name = f"{code(pair.first)} > {code(pair.second)}"
            row = rows.setdefault(name, {"P(X > Y)": name})
            sizes = f"{pair.cells}; {pair.runs[0]}, {pair.runs[1]}"
            row[f"{group} (cells; runs of X, of Y)"] = f"{interval(pair.probability)} ({sizes})"
    if not rows:
        return []
    return [*view.drawn(kind="improvement"), EXPLAINED, table_text(list(rows.values()))]


def figure(by_group: dict[str, list[Improvement]], summary: Summary) -> Figure:
    """P(X > Y) of every pair of learning agents with its 95 % interval; 0.5 is no difference."""
    cells = cells_of(summary)
    every = [pair for pairs in by_group.values() for pair in pairs]
    names = list(dict.fromkeys((pair.first, pair.second) for pair in every))
    columns: dict[str, list[Dot]] = {}
    for group, pairs in by_group.items():
        for pair in pairs:
            remark = f"{cells_text(pair.cells)} only" if pair.cells < cells[group] else ""
            look = Look(look_of(pair.first).color, "o", size=5)
            place = names.index((pair.first, pair.second))
            dot = Dot("", pair.probability, place, look, remark=remark, thick=True)
            columns.setdefault(group_title(group, cells[group]), []).append(dot)
    labels = [f"{cut(first, 24)} > {cut(second, 24)}" for first, second in names]
    return replace(
        by_rows(labels, columns, Axis("P(X > Y)", SHARE), undecided=0.5),
        height=1.1 + 0.3 * len(names),
        kind="improvement",
        text="Probability of improvement",
    )


SECTION = Section(
    TITLE,
    lambda findings: improvements(findings.summary),
    render,
    figures=lambda by_group, summary: [figure(by_group, summary)] if any(by_group.values()) else [],
)
