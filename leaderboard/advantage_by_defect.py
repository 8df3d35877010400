"""How an agent's advantage over `STANDARD` changes with the audited defect."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from symsteer.leaderboard.defects import Audit, AuditedDefect, defect_of, dial_of
from symsteer.leaderboard.keys import Key
from symsteer.leaderboard.known_agents import STANDARD
from symsteer.leaderboard.pairs import advantage
from symsteer.leaderboard.rows import MIN_SEEDS, Summary, Table
from symsteer.leaderboard.runs import Pair
from symsteer.leaderboard.statistics import (
    RESAMPLES,
    Array,
    BootstrapEstimate,
    Interval,
    Sample,
    cell_estimates,
    combined,
    crossed_bootstrap,
)
from symsteer.variant import UNBROKEN

CROSSING_GRID = 101
"""Defects at which the sign of a fitted advantage is asked for."""


@dataclass(frozen=True)
class Point:
    """One table with its defect: the differences of two agents by pair of runs."""

    table: Table
    defect: AuditedDefect
    pairs: Mapping[Pair, Sample]

    @cached_property
    def advantage(self) -> Interval:
        """Mean of the differences."""
        return crossed_bootstrap(list(self.pairs.values()))

    @property
    def counts(self) -> bool:
        """Whether it has the runs that a verdict needs."""
        return len(self.pairs) >= MIN_SEEDS

    @property
    def policies(self) -> int:
        """How many base policies it has pairs on."""
        return len({policy for policy, _ in self.pairs})

    @property
    def dial(self) -> str:
        """The variant without its strength; `none` for the unbroken control."""
        return dial_of(self.table.key.variant)

    @property
    def setting(self) -> Key:
        """What the points have in common between which base policies can be compared."""
        return replace(self.table.key, breaking=(False, UNBROKEN))


@dataclass(frozen=True)
class Line:
    """The fit to one setting's points: through `centre` (defect, advantage), over `span`."""

    setting: Key
    centre: tuple[float, float]
    span: tuple[float, float]


@dataclass(frozen=True)
class Crossing:
    """The defect at which a fitted advantage is 0, in the range of the fit.

    Attributes:
        value: None if the line does not cross 0 in the range.
        low, high: the advantage may be 0 between them (95 %); None at an end of the range.
        before, after: sign of the advantage at the ends of the range, 0 if undecided.
    """

    value: float | None
    low: float | None
    high: float | None
    before: int
    after: int


@dataclass(frozen=True)
class Fit:
    """Least squares with an intercept for each base policy, so that only the dials move it.

    Attributes:
        slope: change of the advantage per 1 of defect.
        policies: base policies that were steered at two defects or more.
        lines: the mean over the policies of each setting.
        level: advantage at the mean defect `centre`.
    """

    slope: BootstrapEstimate
    policies: int
    lines: tuple[Line, ...]
    level: BootstrapEstimate
    centre: float

    @property
    def settings(self) -> set[Key]:
        """The settings whose points it is about."""
        return {line.setting for line in self.lines}

    def at(self, defect: float) -> Interval:
        """The advantage on the fitted line."""
        return combined([self.level, self.slope], [1, defect - self.centre]).interval()

    def crossing(self) -> Crossing:
        """Where the line crosses 0: by Fieller's method, the defects at which 0 is not excluded."""
        ends = [end for line in self.lines for end in line.span]
        grid = np.linspace(min(ends), max(ends), CROSSING_GRID)
        signs = np.array([self.at(float(x)).sign for x in grid])
        zero = self.centre - self.level.value / self.slope.value if self.slope.value else np.inf
        undecided = grid[signs == 0]
        return Crossing(
            float(zero) if grid[0] <= zero <= grid[-1] else None,
            float(undecided[0]) if len(undecided) and signs[0] else None,
            float(undecided[-1]) if len(undecided) and signs[-1] else None,
            int(signs[0]),
            int(signs[-1]),
        )

    @property
    def reason(self) -> str:
        """Why the slope decides nothing, whatever its interval; empty if it may."""
        if self.policies >= MIN_SEEDS:
            return ""
        return f"base policies at several defects: {self.policies}, {MIN_SEEDS} are needed"


def points_of(
    summary: Summary, audit: Audit, embodiment: str, agent: str, measure: str
) -> list[Point]:
    """The audited tables of an embodiment with paired runs of an agent and of `STANDARD`.

    Only those with the usual budget and number of demonstrations (`Summary.usual_tables`).
    """
    points = []
    for table in summary.usual_tables:
        defect = defect_of(table.key, audit)
        if defect is None or table.key.embodiment != embodiment:
            continue
        if pairs := advantage(table, agent, STANDARD, measure):
            points.append(Point(table, defect, pairs))
    return points


def fit(points: Sequence[Point], resamples: int = RESAMPLES, seed: int = 0) -> Fit | None:
    """The slope within base policies; None where none was steered at two different defects.

    Every base policy (where a setting has one only, every run) has an intercept of its own, so what
    policies or tasks differ in by themselves does not enter. Resamples draw policies and episodes
    (`cell_estimates`), and each defect within its interval. The points themselves are not drawn.
    """
    defects = np.array([point.defect.value for point in points])
    settings = _steered(points)
    every = [unit for units in settings.values() for unit in units]
    if not every:
        return None
    total = sum(float((_centred(defects[list(unit)]) ** 2).sum()) for unit in every)
    cells = [
        [Sample.weighted(list(unit.values()), _centred(defects[list(unit)])) for unit in units]
        for units in settings.values()
    ]
    estimates = cell_estimates(cells, resamples=resamples)
    slope = combined(estimates, [len(units) / total for units in settings.values()])
    generator = np.random.default_rng(seed)
    drawn = np.stack([point.defect.draw(resamples, generator) for point in points])
    rise, run = np.zeros(resamples), np.zeros(resamples)
    for unit in every:
        x = _centred(drawn[list(unit)])
        rise += (x * np.array([[sample.value] for sample in unit.values()])).sum(axis=0)
        run += (x**2).sum(axis=0)
    moved = np.divide(rise, run, out=np.full(resamples, slope.value), where=run > 0)
    lines = []
    for setting, units in settings.items():
        x = np.concatenate([defects[list(unit)] for unit in units])
        y = [sample.value for unit in units for sample in unit.values()]
        centre = float(x.mean()), float(np.mean(y))
        lines.append(Line(setting, centre, (float(x.min()), float(x.max()))))
    means = [[Sample.mean(list(unit.values())) for unit in units] for units in settings.values()]
    shares = [len(units) / len(every) for units in settings.values()]
    return Fit(
        level=combined(cell_estimates(means, resamples=resamples), shares),
        centre=float(np.mean([defects[list(unit)].mean() for unit in every])),
        slope=replace(slope, episodes=slope.episodes + moved - slope.value),
        policies=len({sample.policy for unit in every for sample in unit.values()}),
        lines=tuple(lines),
    )


Unit = dict[int, Sample]
"""What a base policy has at each point, by the point's index."""


def _steered(points: Sequence[Point]) -> dict[Key, list[Unit]]:
    """The base policies of each setting that were steered at two defects or more."""
    units_of_setting: dict[Key, list[Unit]] = {}
    for setting in sorted({point.setting for point in points}):
        here = {i: point for i, point in enumerate(points) if point.setting == setting}
        units = [unit for unit in _units(here) if len({here[i].defect.value for i in unit}) > 1]
        if units:
            units_of_setting[setting] = units
    return units_of_setting


def _units(points: Mapping[int, Point]) -> list[Unit]:
    """What each base policy has at each point of a setting; each run if there is one policy."""
    alone = len({policy for point in points.values() for policy, _ in point.pairs}) == 1
    samples_of: dict[Pair, dict[int, list[Sample]]] = defaultdict(lambda: defaultdict(list))
    for index, point in points.items():
        for (policy, seed), sample in point.pairs.items():
            samples_of[policy, seed if alone else 0][index].append(sample)
    return [
        {index: Sample.mean(samples) for index, samples in samples_of[unit].items()}
        for unit in sorted(samples_of)
    ]


def _centred(values: Array) -> Array:
    """Less the mean along the first axis."""
    return values - values.mean(axis=0)
