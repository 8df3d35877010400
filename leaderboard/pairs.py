"""Paired differences of two rows: by base policy and seed, then by evaluation and episode."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from statistics import fmean

from symsteer.leaderboard.rows import AgentRow, Table
from symsteer.leaderboard.runs import Pair, Run, aligned, episode_success
from symsteer.leaderboard.statistics import (
    EpisodeBlock,
    Interval,
    Sample,
    area_weights,
    crossed_bootstrap,
    paired_differences,
)

MEASURES = ("auc", "success")
"""What an advantage is measured in: area under the curve, final-window success."""

SHORT_NAMES = {"auc": "AUC", "success": "success"}


def advantage(table: Table, first: str, second: str, measure: str) -> dict[Pair, Sample]:
    """Paired differences of two agents in a table; empty if one of them is missing."""
    rows = table.row_of(first), table.row_of(second)
    if rows[0] is None or rows[1] is None:
        return {}
    if measure == "auc":
        return area_pairs(rows[0], rows[1], table.key.env_steps)
    return success_pairs(rows[0], rows[1])


def compare(first: AgentRow, second: AgentRow) -> Interval | None:
    """Paired difference of final-window success; None without common episodes."""
    pairs = success_pairs(first, second)
    return crossed_bootstrap(list(pairs.values())) if pairs else None


def success_pairs(first: AgentRow, second: AgentRow) -> dict[Pair, Sample]:
    """Differences of final-window success, first minus second, by pair of runs.

    Two learners are paired by run seed on the same base policy, then by evaluation (`aligned`) and
    episode seed; with a reference, which is evaluated once, the episode seed alone pairs
    (`reference_success`).
    """
    if first.is_reference and not second.is_reference:
        reverse = success_pairs(second, first)
        return {pair: Sample.weighted([sample], [-1]) for pair, sample in reverse.items()}
    pairs = {}
    for run in first.finished:
        if second.is_reference:
            reference = reference_success(run, second.finished)
            other = {key: reference[key[1]] for key in run.window if key[1] in reference}
        else:
            partner = _partner(run, second)
            points = aligned(run, partner) if partner else {}
            other = {
                (step, seed): partner.window[points[step], seed]
                for step, seed in run.window
                if partner and (points.get(step), seed) in partner.window
            }
        if differences := paired_differences(run.window, other):
            by_seed = ((seed, value) for (_, seed), value in differences.items())
            pairs[run.pair] = Sample.pooled(by_seed, run.policy)
    return pairs


def reference_success(run: Run, references: Sequence[Run]) -> dict[int, float]:
    """Success of a reference on the base policy that `run` steers, by episode seed.

    Taken from the reference's run with the same policy (content hash) and the same run seed, else
    from the mean of all its runs with that policy; empty if there is none.
    """
    same = [reference for reference in references if reference.policy == run.policy]
    same = [reference for reference in same if reference.seed == run.seed] or same
    values: dict[int, list[float]] = defaultdict(list)
    for reference in same:
        for seed, success in reference.final_success.items():
            values[seed].append(success)
    return {seed: fmean(successes) for seed, successes in values.items()}


def area_pairs(first: AgentRow, second: AgentRow, budget: int) -> dict[Pair, Sample]:
    """Differences of the area under the curve, first minus second, by pair of runs.

    Over the evaluations that both runs have (`aligned`), on the episodes that both have there.
    """
    pairs = {}
    for run in first.finished:
        partner = _partner(run, second)
        if partner and (difference := area_difference(run, partner, budget)):
            pairs[run.pair] = difference
    return pairs


def area_difference(run: Run, partner: Run, budget: int) -> Sample | None:
    """Difference of the area under the curve, first minus second; None without a common episode."""
    blocks: dict[int, EpisodeBlock] = {}
    for step, twin in aligned(run, partner).items():
        mine, theirs = run.curve[step], partner.curve[twin]
        if differences := paired_differences(episode_success(mine), episode_success(theirs)):
            blocks[step] = Sample.pooled(differences.items()).blocks[0]
    if not blocks:
        return None
    begin = max(run.area_begin, partner.area_begin)
    return Sample(tuple(blocks.values()), area_weights(list(blocks), budget, begin), run.policy)


def _partner(run: Run, row: AgentRow) -> Run | None:
    """The row's run with the same seed on the same base policy: on another one, success differs."""
    return next((other for other in row.finished if other.pair == run.pair), None)
