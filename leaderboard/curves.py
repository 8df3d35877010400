"""Curves over environment steps and over directions: what the figures and the site draw of runs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from symsteer.leaderboard.statistics import Sample, success_interval
from symsteer.leaderboard.summary import Row, Run, aligned, episode_success

BAND_RESAMPLES = 1000

SECTORS = 8
"""Sectors in which successes are counted by direction."""


@dataclass(frozen=True)
class Curve:
    """Values over environment steps, or degrees, with the ends of their 95 % intervals."""

    steps: list[float]
    values: list[float]
    low: list[float]
    high: list[float]


def success_curve(row: Row) -> Curve:
    """The IQM of success over the finished runs of a row, where all of them were evaluated."""
    points = _common(row.finished)
    cells = [
        [
            Sample.pooled(episode_success(run.curve[step]).items(), run.policy)
            for run, step in zip(row.finished, point, strict=True)
        ]
        for point in points
    ]
    return _with_bands(_places(points), cells)


def _with_bands(steps: list[float], cells: Sequence[Sequence[Sample]]) -> Curve:
    bands = [success_interval(runs, BAND_RESAMPLES) for runs in cells]
    return Curve(steps, [b.value for b in bands], [b.low for b in bands], [b.high for b in bands])


def direction_curve(row: Row) -> Curve | None:
    """The IQM of success at the end by the direction in which an episode has to go.

    Steps are the middles of the sectors in degrees, -180 to 180; the first one is the last one
    again. Sectors without an episode are left out. None if no finished run has directions.
    """
    sectors: list[list[Sample]] = [[] for _ in range(SECTORS)]
    for run in row.finished:
        final = run.record.final
        if final is None or final.episodes.direction is None:
            continue
        success = episode_success(final)
        found: list[list[tuple[int, float]]] = [[] for _ in range(SECTORS)]
        for seed, angle in zip(final.episodes.seed, final.episodes.direction, strict=True):
            if angle is not None:
                sector = round(angle * SECTORS / (2 * math.pi)) % SECTORS
                found[sector].append((seed, success[seed]))
        for sector, values in enumerate(found):
            if values:
                sectors[sector].append(Sample.pooled(values, run.policy))
    # Sector 4 of 8 is at 180 degrees, and at -180.
    turned = [(k - SECTORS // 2, sectors[(k - SECTORS // 2) % SECTORS]) for k in range(SECTORS + 1)]
    shown = [(k * 360 / SECTORS, runs) for k, runs in turned if runs]
    if not shown:
        return None
    return _with_bands([degrees for degrees, _ in shown], [runs for _, runs in shown])


def series(run: Run, name: str) -> tuple[list[int], list[float]]:
    """Steps and finite values of a diagnostic of one run."""
    pairs = [
        (step, value)
        for step, evaluation in run.curve.items()
        if (value := evaluation.diagnostics.get(name)) is not None
    ]
    return [step for step, _ in pairs], [value for _, value in pairs]


def mean_series(runs: Sequence[Run], name: str) -> tuple[list[float], list[float]]:
    """Steps and mean of a diagnostic over runs, where all have measured it."""
    found = [dict(zip(*series(run, name), strict=True)) for run in runs]
    points = [
        point
        for point in _common(runs)
        if all(step in one for step, one in zip(point, found, strict=True))
    ]
    means = [
        float(np.mean([one[step] for step, one in zip(point, found, strict=True)]))
        for point in points
    ]
    return _places(points), means


def _common(runs: Sequence[Run]) -> list[tuple[int, ...]]:
    """The points of the curve at which all runs were evaluated: env_steps of each run there."""
    if not runs:
        return []
    twins = [aligned(runs[0], run) for run in runs]
    steps = [step for step in runs[0].curve if all(step in twin for twin in twins)]
    return [tuple(twin[step] for twin in twins) for step in steps]


def _places(points: Sequence[tuple[int, ...]]) -> list[float]:
    """Where points of several runs are drawn: at the median of their steps."""
    return [float(np.median(point)) for point in points]
