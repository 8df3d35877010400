"""Pairs of runs, what changed from A to B in each cell and over all of them, and the verdict.

All differences are B minus A, within pairs of runs and on the same episodes; intervals and the
number of pairs that a verdict needs are those of the leaderboard (docs/metrics.md).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from symsteer.leaderboard.compare.sides import Leftover
from symsteer.leaderboard.keys import Key
from symsteer.leaderboard.pairs import area_difference
from symsteer.leaderboard.rows import MIN_SEEDS
from symsteer.leaderboard.runs import Run
from symsteer.leaderboard.statistics import (
    Interval,
    Sample,
    paired_differences,
    stratified_bootstrap,
    units_of,
)

Measure = Literal["success", "auc", "q_bias"]

DECISIVE: tuple[Measure, ...] = ("success", "auc")
"""The measures that the verdict follows from."""

Samples = tuple[Sample, Sample, Sample]
"""A measure of two paired runs: A's value, B's value, and B minus A."""


@dataclass(frozen=True)
class Change:
    """A measure of one cell, or the mean over cells: A's value, B's value, and B minus A."""

    a: float
    b: float
    difference: Interval
    pairs: int
    counts: bool
    """Whether it has the pairs that a verdict needs."""


@dataclass(frozen=True)
class RunPair:
    a: Run
    b: Run

    @property
    def same_episodes(self) -> bool:
        """Whether all episodes of all evaluations agree bit for bit."""
        mine, theirs = self.a.record.evaluations, self.b.record.evaluations
        return [e.episodes for e in mine] == [e.episodes for e in theirs]

    @property
    def same_diagnostics(self) -> bool:
        """Whether all diagnostics of all evaluations agree bit for bit."""
        mine, theirs = (
            [(e.diagnostics, e.nonfinite) for e in run.record.evaluations]
            for run in (self.a, self.b)
        )
        return mine == theirs


@dataclass(frozen=True)
class PairedCell:
    """The pairs of one cell and agent.

    Attributes:
        key: the cell.
        label: agent and settings of A; empty where they are the same in all cells.
        pairs: at least one.
    """

    key: Key
    label: str
    pairs: tuple[RunPair, ...]

    @property
    def is_identical(self) -> bool:
        return all(pair.same_episodes for pair in self.pairs)

    @cached_property
    def samples(self) -> dict[Measure, list[Samples]]:
        """Of each measure the pairs that have it."""
        return {
            name: [values for pair in self.pairs if (values := measure(pair.a, pair.b))]
            for name, measure in MEASURES.items()
        }

    @cached_property
    def measures(self) -> dict[Measure, Change]:
        """What the measures that it has changed by."""
        return {name: _change([samples]) for name, samples in self.samples.items() if samples}

    @property
    def seconds(self) -> tuple[float, float]:
        """Of a run of A and of B."""
        return _seconds(self.pairs)


@dataclass(frozen=True)
class Changes:
    """Everything that a comparison says.

    Attributes:
        cells: at least one.
        alone: runs of A, and runs of B, that are in no pair.
        one_sided: settings that only the records of A have, and those that only B's have; they do
            not count.
        changed: options of the agent that differ within pairs, as texts.
        margin: how much worse B may be.
    """

    cells: tuple[PairedCell, ...]
    alone: tuple[tuple[Leftover, ...], tuple[Leftover, ...]]
    one_sided: tuple[tuple[str, ...], tuple[str, ...]]
    changed: tuple[str, ...]
    margin: float

    @property
    def pairs(self) -> list[RunPair]:
        return [pair for cell in self.cells for pair in cell.pairs]

    @property
    def seconds(self) -> tuple[float, float]:
        """Of a run of A and of B, mean over all pairs."""
        return _seconds(self.pairs)

    @cached_property
    def overall(self) -> dict[Measure, Change]:
        """The mean over the cells that have enough pairs; over all if none has."""
        overall = {}
        for name in MEASURES:
            having = [cell.samples[name] for cell in self.cells if cell.samples[name]]
            enough = [samples for samples in having if len(samples) >= MIN_SEEDS]
            if having:
                overall[name] = _change(enough or having)
        return overall

    @property
    def decisive(self) -> dict[Measure, Interval]:
        """The differences that the verdict follows from."""
        changes = {name: self.overall[name] for name in DECISIVE if name in self.overall}
        return {name: change.difference for name, change in changes.items() if change.counts}

    @property
    def verdict(self) -> Literal["identical", "none", "worse", "better", "not worse"]:
        """Whether B is clearly worse than A, by more than the margin, in success or in AUC.

        `identical`: all episodes of all pairs agree. `none`: no cell has enough pairs.
        """
        if all(cell.is_identical for cell in self.cells):
            return "identical"
        if not self.decisive:
            return "none"
        if any(interval.high < -self.margin for interval in self.decisive.values()):
            return "worse"
        signs = {interval.sign for interval in self.decisive.values()}
        return "better" if 1 in signs and -1 not in signs else "not worse"


def _change(cells: Sequence[Sequence[Samples]]) -> Change:
    """The mean over cells of the mean over base policies."""

    def level(index: int) -> float:
        units = [units_of([samples[index] for samples in pairs]).values() for pairs in cells]
        return float(np.mean([np.mean([unit.value for unit in values]) for values in units]))

    return Change(
        a=level(0),
        b=level(1),
        difference=stratified_bootstrap([[samples[2] for samples in pairs] for pairs in cells]),
        pairs=sum(map(len, cells)),
        counts=min(map(len, cells)) >= MIN_SEEDS,
    )


def _seconds(pairs: Sequence[RunPair]) -> tuple[float, float]:
    clocks = [(pair.a.record.wall_clock.total, pair.b.record.wall_clock.total) for pair in pairs]
    a, b = np.mean(clocks, axis=0)
    return float(a), float(b)


def _success(a: Run, b: Run) -> Samples:
    """Success in the final evaluation; paired runs have the same held-out episodes there."""
    one, two = a.final_success, b.final_success
    first, second, difference = (
        Sample.pooled(values.items(), a.policy)
        for values in (one, two, paired_differences(two, one))
    )
    return first, second, difference


def _area(a: Run, b: Run) -> Samples | None:
    """Area under the success curve, of runs that have one: references are evaluated once."""
    if a.is_reference or b.is_reference:
        return None
    difference = area_difference(b, a, a.record.settings.env_steps)
    first, second = (Sample.constant(run.area, run.policy) for run in (a, b))
    return (first, second, difference) if difference else None


def _bias(a: Run, b: Run) -> Samples | None:
    """Size of the bias of Q at the end, where both runs have measured it."""
    one, two = a.last("q_bias"), b.last("q_bias")
    if one is None or two is None:
        return None
    first, second, difference = (
        Sample.constant(value, a.policy) for value in (abs(one), abs(two), abs(two) - abs(one))
    )
    return first, second, difference


MEASURES: dict[Measure, Callable[[Run, Run], Samples | None]] = {
    "success": _success,
    "auc": _area,
    "q_bias": _bias,
}
