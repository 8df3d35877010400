"""The numbers of each row: success, differences, rank, steps to a threshold."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from symsteer.leaderboard.grouping import grouped
from symsteer.leaderboard.known_agents import BASE
from symsteer.leaderboard.pairs import compare, reference_success, success_pairs
from symsteer.leaderboard.rows import MIN_SEEDS, AgentRow, Summary, Table
from symsteer.leaderboard.runs import Run, episode_success
from symsteer.leaderboard.statistics import (
    Sample,
    crossed_bootstrap,
    paired_differences,
    steps_to_threshold,
    success_interval,
)

THRESHOLD = 0.8
"""Steps are counted until this share of the best learner's final success."""


def summarize(runs: Sequence[Run]) -> Summary:
    """Group runs into tables and compute every row; independent of the order of `runs`."""
    tables, set_aside = grouped(runs)
    for table in tables:
        for row in table.rows:
            if row.finished:
                _measure(row)
        _compare(table)
        _rank(table.trusted)
    return Summary(tables, set_aside)


def _measure(row: AgentRow) -> None:
    """Compute the numbers of a row that need no other row."""
    row.success = success_interval([run.success_sample for run in row.finished])
    row.last = success_interval(
        [Sample.pooled(run.final_success.items(), run.policy) for run in row.finished]
    )
    rising = [run for run in row.finished if run.rise and not row.is_reference]
    if rising:
        row.rise = crossed_bootstrap([Sample.pooled(r.rise.items(), r.policy) for r in rising])
    if row.search_steps is None:
        row.area = float(np.mean([run.area for run in row.finished]))


def _compare(table: Table) -> None:
    """Compute the numbers that compare a row with the base, a reference or the best learner."""
    measured = [(row.success.value, row) for row in table.trusted if row.success]
    learners = [success for success, row in measured if row.role == "learner"]
    references = [(success, row) for success, row in measured if row.is_reference]
    if learners:
        table.threshold = THRESHOLD * max(learners)
    if references:
        _, table.best_reference = max(references, key=lambda each: each[0])
    base = table.row_of(BASE)
    for row in table.rows:
        if base and row.agent != BASE:
            row.difference = compare(row, base)
            if not row.is_reference:
                row.dip = min(
                    (dip for run in row.finished for dip in _dips(run, base)), default=None
                )
        if table.threshold is not None and not row.is_reference:
            row.threshold_steps = [
                steps_to_threshold(*run.points, table.threshold) for run in row.finished
            ]
    if table.best_reference:
        for row in table.learners:
            pairs = success_pairs(row, table.best_reference)
            row.pairs_with_best = len(pairs)
            row.against_best = crossed_bootstrap(list(pairs.values())) if pairs else None


def _dips(run: Run, base: AgentRow) -> list[float]:
    """How far each evaluation lies below the base policy, at most 0."""
    reference = reference_success(run, base.finished)
    common = (paired_differences(episode_success(e), reference) for e in run.curve.values())
    return [min(0.0, float(np.mean(list(pairs.values())))) for pairs in common if pairs]


def _rank(rows: Sequence[AgentRow]) -> None:
    """Rank learners: 1 + the number of learners that are clearly better.

    Two rows are compared if they have `MIN_SEEDS` pairs of runs, with the same seed on the same
    base policy; a row that can be compared with no other one gets no rank.
    """
    for first, second in combinations([row for row in rows if row.role == "learner"], 2):
        pairs = success_pairs(first, second)
        if len(pairs) < MIN_SEEDS:
            continue
        difference = crossed_bootstrap(list(pairs.values()))
        first.rank, second.rank = first.rank or 1, second.rank or 1
        if difference.sign:
            worse = second if difference.sign > 0 else first
            worse.rank = (worse.rank or 1) + 1
