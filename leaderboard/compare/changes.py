"""What changed from A to B, in each cell and over all of them, and the verdict.

All differences are B minus A, within pairs of runs and on the same episodes; intervals and the
number of pairs that a verdict needs are those of the leaderboard (docs/metrics.md).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from symsteer.leaderboard.compare.pairing import Cell, Pairing, RunPair
from symsteer.leaderboard.statistics import (
    Interval,
    Sample,
    paired_differences,
    stratified_bootstrap,
    units_of,
)
from symsteer.leaderboard.summary import MIN_SEEDS, area_difference

Measure = Literal["success", "auc", "q_bias"]
Verdict = Literal["identical", "none", "worse", "better", "not worse"]

DECISIVE: tuple[Measure, ...] = ("success", "auc")
"""The measures that the verdict follows from."""


@dataclass(frozen=True)
class Paired:
    """A measure of two paired runs: A's value, B's value, and B minus A."""

    a: Sample
    b: Sample
    difference: Sample


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
class CellChanges:
    """A cell, the measures that it has, and seconds of a run of A and of B."""

    cell: Cell
    measures: dict[Measure, Change]
    seconds: tuple[float, float]


@dataclass(frozen=True)
class Changes:
    """Everything that the comparison says.

    Attributes:
        pairing: the pairs.
        cells: in the order of the pairing.
        overall: the mean over the cells that have enough pairs; over all if none has.
        seconds: of a run of A and of B, mean over all pairs.
        margin: how much worse B may be.
    """

    pairing: Pairing
    cells: tuple[CellChanges, ...]
    overall: dict[Measure, Change]
    seconds: tuple[float, float]
    margin: float

    @property
    def verdict(self) -> Verdict:
        """Whether B is clearly worse than A, by more than the margin, in success or in AUC.

        `identical`: all episodes of all pairs agree. `none`: no cell has enough pairs.
        """
        if all(cell.is_identical for cell in self.pairing.cells):
            return "identical"
        found = [
            change.difference
            for name in DECISIVE
            if (change := self.overall.get(name)) and change.counts
        ]
        if not found:
            return "none"
        if any(interval.high < -self.margin for interval in found):
            return "worse"
        signs = {interval.sign for interval in found}
        return "better" if 1 in signs and -1 not in signs else "not worse"


def find_changes(pairing: Pairing, margin: float = 0.0) -> Changes:
    """Compute every number of a comparison."""
    samples: dict[Measure, list[list[Paired]]] = {
        name: [[found for pair in cell.pairs if (found := measure(pair))] for cell in pairing.cells]
        for name, measure in MEASURES.items()
    }
    cells = [
        CellChanges(
            cell,
            {name: _change([found[index]]) for name, found in samples.items() if found[index]},
            _seconds(cell.pairs),
        )
        for index, cell in enumerate(pairing.cells)
    ]
    overall = {}
    for name, by_cell in samples.items():
        having = [found for found in by_cell if found]
        enough = [found for found in having if len(found) >= MIN_SEEDS]
        if having:
            overall[name] = _change(enough or having)
    return Changes(pairing, tuple(cells), overall, _seconds(pairing.pairs), margin)


def _change(cells: Sequence[Sequence[Paired]]) -> Change:
    return Change(
        _level([[pair.a for pair in pairs] for pairs in cells]),
        _level([[pair.b for pair in pairs] for pairs in cells]),
        stratified_bootstrap([[pair.difference for pair in pairs] for pairs in cells]),
        sum(map(len, cells)),
        min(map(len, cells)) >= MIN_SEEDS,
    )


def _level(cells: Sequence[Sequence[Sample]]) -> float:
    """Mean over cells of the mean over base policies."""
    units = [[unit.value for unit in units_of(runs).values()] for runs in cells]
    return float(np.mean([np.mean(values) for values in units]))


def _seconds(pairs: Sequence[RunPair]) -> tuple[float, float]:
    clocks = [(pair.a.record.wall_clock.total, pair.b.record.wall_clock.total) for pair in pairs]
    a, b = np.mean(clocks, axis=0)
    return float(a), float(b)


def _success(pair: RunPair) -> Paired:
    """Success in the final evaluation; paired runs have the same held-out episodes there."""
    a, b = pair.a.final_success, pair.b.final_success
    values = a, b, paired_differences(b, a)
    return Paired(*(Sample.pooled(one.items(), pair.a.policy) for one in values))


def _area(pair: RunPair) -> Paired | None:
    """Area under the success curve, of runs that have one: references are evaluated once."""
    if pair.a.is_reference or pair.b.is_reference:
        return None
    difference = area_difference(pair.b, pair.a, pair.a.record.settings.env_steps)
    a, b = (Sample.constant(run.area, run.policy) for run in (pair.a, pair.b))
    return Paired(a, b, difference) if difference else None


def _bias(pair: RunPair) -> Paired | None:
    """Size of the bias of Q at the end, where both runs have measured it."""
    a, b = pair.a.last("q_bias"), pair.b.last("q_bias")
    if a is None or b is None:
        return None
    values = abs(a), abs(b), abs(b) - abs(a)
    return Paired(*(Sample.constant(one, pair.a.policy) for one in values))


MEASURES: dict[Measure, Callable[[RunPair], Paired | None]] = {
    "success": _success,
    "auc": _area,
    "q_bias": _bias,
}
