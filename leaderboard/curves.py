"""Curves over environment steps and over directions: for figures, the site and a terminal."""

from __future__ import annotations

import math
import textwrap
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from symsteer.leaderboard.known_agents import STANDARD
from symsteer.leaderboard.pairs import success_pairs
from symsteer.leaderboard.row_numbers import summarize
from symsteer.leaderboard.rows import MIN_SEEDS, AgentRow, Table
from symsteer.leaderboard.runs import Run, aligned, episode_success, load_runs
from symsteer.leaderboard.statistics import Sample, crossed_bootstrap, success_interval
from symsteer.leaderboard.text import interval
from symsteer.tables import aligned as aligned_table

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


def success_curve(row: AgentRow) -> Curve:
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


def direction_curve(row: AgentRow) -> Curve | None:
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
        by_sector: list[list[tuple[int, float]]] = [[] for _ in range(SECTORS)]
        for seed, angle in zip(final.episodes.seed, final.episodes.direction, strict=True):
            if angle is not None:
                sector = round(angle * SECTORS / (2 * math.pi)) % SECTORS
                by_sector[sector].append((seed, success[seed]))
        for sector, values in enumerate(by_sector):
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
    values = run.diagnostic(name)
    return list(values), list(values.values())


def mean_series(runs: Sequence[Run], name: str) -> tuple[list[float], list[float]]:
    """Steps and mean of a diagnostic over runs, where all have measured it."""
    measured = [run.diagnostic(name) for run in runs]
    points = [
        point
        for point in _common(runs)
        if all(step in values for step, values in zip(point, measured, strict=True))
    ]
    means = [
        float(np.mean([values[step] for step, values in zip(point, measured, strict=True)]))
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


def curves_as_text(records: Sequence[Path]) -> str:
    """Mean success of each agent at every evaluation, and how sure its place is; by cell.

    Args:
        records: record files, run folders, or folders of these.

    Raises:
        UserError: for records that cannot be read.
    """
    return "\n\n".join(_cell(table) for table in summarize(load_runs(records)).tables)


def _cell(table: Table) -> str:
    curves = {row.label: _curve(row) for row in table.rows if row.finished}
    steps = sorted({step for curve in curves.values() for step in curve})
    world = " and ".join(table.key.broken_by) or "unbroken"
    rows = [
        [f"  {name}", *(f"{curve[step]:.0%}" if step in curve else "" for step in steps)]
        for name, curve in curves.items()
    ]
    header = ["  success after steps", *(f"{step}k" for step in steps)]
    title = f"{table.key.task} {table.key.embodiment}, {world}"
    return "\n".join([title, aligned_table(header, rows), *_certainties(table)])


def _certainties(table: Table) -> list[str]:
    """How sure it is that a learner ends above or below `standard`: a sentence for each."""
    sentences, standard = [], table.row_of(STANDARD)
    for row in table.learners:
        pairs = success_pairs(row, standard) if standard and row is not standard else {}
        if not standard or not pairs:
            continue
        success, policies = crossed_bootstrap([*pairs.values()]), {p.policy for p in pairs.values()}
        sure = "is clearly" if success.sign else "is not clearly"
        sentence = (
            f"{row.label} {sure if len(pairs) >= MIN_SEEDS else 'may be'} "
            f"{'above' if success.value > 0 else 'below'} {standard.label}: "
            f"{interval(success, sign=True)} of success in the last fifth of the steps (95 % "
            f"interval; base policies: {len(policies)}; pairs of runs: {len(pairs)}, and a verdict "
            f"needs {MIN_SEEDS})."
        )
        sentences.append(textwrap.indent(textwrap.fill(sentence, 98), "  "))
    return sentences


def _curve(row: AgentRow) -> dict[int, float]:
    """Mean success of a row's finished runs by thousands of steps.

    A reference does not learn: its one evaluation stands in the last column.
    """
    rates: dict[int, list[float]] = defaultdict(list)
    for run in row.finished:
        for step, evaluation in run.curve.items():
            at = run.record.settings.env_steps if evaluation.final else step
            rates[round(at / 1_000)].append(evaluation.success_once)
    return {step: float(np.mean(values)) for step, values in rates.items()}
