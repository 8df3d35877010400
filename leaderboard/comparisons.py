"""Comparisons over all tables: performance profiles and the probability of improvement.

Both follow Agarwal et al. 2021 (arXiv 2108.13264): a number for each run, all runs shown, intervals
from a bootstrap that is stratified by table.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from symsteer.leaderboard.paper import BASE, STANDARD, WITH_SYMMETRY
from symsteer.leaderboard.records import Role
from symsteer.leaderboard.statistics import (
    Array,
    Interval,
    performance_profile,
    probability_of_improvement,
)
from symsteer.leaderboard.summary import Row, Summary, Table, reference_success

GROUPS = ("unbroken", "broken")
MANY_PAIRS = 28
"""With more pairs of agents, only those with an agent of `AGAINST` are compared."""

AGAINST = (STANDARD, WITH_SYMMETRY[0])
THRESHOLDS = np.linspace(-0.5, 1.0, 151)
"""Where the profiles are drawn: shares of the gap between the frozen base and certain success."""


@dataclass(frozen=True)
class Profile:
    """Share of an agent's runs that close at least each share of the gap (`THRESHOLDS`)."""

    agent: str
    role: Role
    cells: int
    runs: int
    share: Array
    low: Array
    high: Array


@dataclass(frozen=True)
class Improvement:
    """P(a run of `first` beats a run of `second` on one base policy), mean over the tables that
    have both."""

    first: str
    second: str
    cells: int
    runs: tuple[int, int]
    probability: Interval


@dataclass(frozen=True)
class Comparisons:
    """What is compared, by group of tables (`GROUPS`); groups without runs are left out."""

    cells: dict[str, int]
    profiles: dict[str, list[Profile]]
    improvements: dict[str, list[Improvement]]


def group_of(table: Table) -> str:
    """`unbroken` for the arm-less control, else `broken`."""
    return GROUPS[bool(table.key.broken_by)]


def compare_agents(summary: Summary) -> Comparisons:
    """Profiles of all agents but the base, and every pair of agents that are no references."""
    result = Comparisons({}, {}, {})
    for group in GROUPS:
        tables = [t for t in summary.tables if group_of(t) == group and t.learners]
        if not tables:
            continue
        result.cells[group] = len(tables)
        result.profiles[group] = profiles(tables, summary.roles)
        result.improvements[group] = improvements(tables, summary.roles)
    return result


def gap_closed(row: Row, base: Row) -> list[tuple[str, float]]:
    """Base policy and (success - base) / (1 - base) of each finished run, final window, same
    episodes.

    0 is the frozen base policy, 1 success in every episode, negative is worse than the base. Runs
    without common episodes, or whose base always succeeds, are left out.
    """
    values = []
    for run in row.finished:
        reference = reference_success(run, base.finished)
        episodes = [(s, reference[key[1]]) for key, s in run.window.items() if key[1] in reference]
        if not episodes:
            continue
        success, of_base = np.mean(episodes, axis=0)
        if of_base < 1:
            values.append((run.policy, float((success - of_base) / (1 - of_base))))
    return values


def profiles(tables: Sequence[Table], roles: Mapping[str, Role]) -> list[Profile]:
    """A profile for every agent but the base that has runs."""
    found = []
    for agent, role in roles.items():
        if agent == BASE:
            continue
        cells = []
        for table in tables:
            row, base = table.row_of(agent), table.row_of(BASE)
            if row and base and (values := gap_closed(row, base)):
                cells.append(values)
        if cells:
            share, low, high = performance_profile(cells, THRESHOLDS)
            runs = sum(map(len, cells))
            found.append(Profile(agent, role, len(cells), runs, share, low, high))
    return found


def improvements(tables: Sequence[Table], roles: Mapping[str, Role]) -> list[Improvement]:
    """Every pair of agents that are no references, the later one of the page's order first.

    In each table, over the base policies that both agents steered. Of more than `MANY_PAIRS` only
    those with an agent of `AGAINST`.
    """
    found = []
    learning = [agent for agent, role in roles.items() if role != "reference"]
    pairs = list(combinations(learning, 2))
    if len(pairs) > MANY_PAIRS:
        pairs = [pair for pair in pairs if set(pair) & set(AGAINST)]
    for second, first in pairs:
        cells = []
        for table in tables:
            rows = [table.row_of(agent) for agent in (first, second)]
            runs = [
                [(run.policy, run.success) for run in row.finished] if row else [] for row in rows
            ]
            common = {policy for policy, _ in runs[0]} & {policy for policy, _ in runs[1]}
            if common:
                mine, theirs = ([run for run in of if run[0] in common] for of in runs)
                cells.append((mine, theirs))
        if cells:
            sizes = sum(len(x) for x, _ in cells), sum(len(y) for _, y in cells)
            probability = probability_of_improvement(cells)
            found.append(Improvement(first, second, len(cells), sizes, probability))
    return found
