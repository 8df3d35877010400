"""Which agent to take in a world, from the map of advantages against audited defects.

The advantage of an agent over `STANDARD` is expected from, in this order: the records of this very
cell; the line of this task; the line of the other tasks. docs/metrics.md has the formulas, and how
the line is tested by leaving tasks out. Nothing is simulated here.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from symsteer.leaderboard.advantage_by_defect import (
    Point,
    Unit,
    drawn_defects,
    fit,
    points_of,
    steered,
)
from symsteer.leaderboard.defects import Audit, AuditedDefect, dial_of, in_order
from symsteer.leaderboard.keys import Key
from symsteer.leaderboard.known_agents import STANDARD, row_place
from symsteer.leaderboard.pairs import MEASURES
from symsteer.leaderboard.rows import MIN_SEEDS, Summary
from symsteer.leaderboard.statistics import (
    RESAMPLES,
    Array,
    BootstrapEstimate,
    Interval,
    Sample,
    cell_estimates,
    combined,
    percentile,
    stratified_bootstrap,
)
from symsteer.variant import UNBROKEN

LEAST_TASKS = 3
"""Other tasks that an expectation for a new one needs."""

LEAST_FREEDOM = 2
"""Degrees of freedom that the distance of cells from their line needs."""

LEAST_DIALS = 2
"""Dials that the line of a part needs: how much dials differ cannot be known from one."""

PART = "part "
"""Begins the name of a kind of break that is a part of the defect, not a dial."""

Source = Literal["this cell", "this task", "other tasks", ""]


@dataclass(frozen=True)
class AuditedWorld:
    """A place on the map: where an agent is wanted."""

    task: str
    embodiment: str
    variant: str
    group: str
    defect: AuditedDefect

    @property
    def kinds(self) -> list[str]:
        """How it is broken, the narrowest first: by its dial, by the part of its defect."""
        dial = dial_of(self.variant)
        return [UNBROKEN] if dial == UNBROKEN else [dial, PART + self.defect.part]

    @classmethod
    def of(cls, point: Point) -> AuditedWorld:
        key = point.table.key
        return cls(key.task, key.embodiment, key.variant, key.group, point.defect)


@dataclass(frozen=True)
class Expected:
    """The expected advantage of an agent over `STANDARD` in a world.

    Attributes:
        value: None if no record says anything.
        interval: 95 %; None if its width is not known.
        source: what it is expected from.
        kind: which cells the line is through: a dial, or a part of the defect.
        cells, policies, tasks: how many it rests on.
        reasons: why it decides nothing, whatever the interval; empty if it may.
        agent, measure: whose and of what; empty before it is known.
    """

    value: float | None = None
    interval: Interval | None = None
    source: Source = ""
    kind: str = ""
    cells: int = 0
    policies: int = 0
    tasks: int = 0
    reasons: tuple[str, ...] = ()
    agent: str = ""
    measure: str = ""

    @property
    def sign(self) -> int:
        """+1 or -1 if it is clearly above or below 0, else 0."""
        return self.interval.sign if self.interval and not self.reasons else 0


@dataclass(frozen=True)
class Choice:
    """Which agents to take for a measure, the best first; none if that is undecided, and why."""

    measure: str
    agents: tuple[str, ...]
    reason: str = ""


@dataclass(frozen=True)
class Advice:
    """What the records say about a world."""

    world: AuditedWorld
    expected: tuple[Expected, ...]
    choices: tuple[Choice, ...]


def advise(summaries: Sequence[Summary], audit: Audit, world: AuditedWorld) -> Advice:
    """What to expect of each learner in a world, and which one to take.

    Args:
        summaries: of the records of each study; runs are paired within one.
        audit: their defects.
        world: where.
    """
    expected = []
    for agent in learners(summaries):
        for measure in MEASURES:
            points = [
                point
                for summary in summaries
                for point in points_of(summary, audit, world.embodiment, agent, measure)
            ]
            if points:
                # Points with few base policies decide nothing, and count only if all are such.
                lines = Lines(decisive(points) or points)
                expected.append(replace(expect(world, lines), agent=agent, measure=measure))
    choices = tuple(choose(m, [e for e in expected if e.measure == m]) for m in MEASURES)
    return Advice(world, tuple(expected), choices)


def learners(summaries: Sequence[Summary]) -> list[str]:
    """The learners of all studies but `STANDARD`, in the page's order."""
    roles = {agent: role for summary in summaries for agent, role in summary.roles.items()}
    names = [agent for agent, role in roles.items() if role == "learner" and agent != STANDARD]
    return sorted(names, key=lambda agent: row_place(agent, "learner"))


def decisive(points: Sequence[Point]) -> list[Point]:
    """The points with enough base policies."""
    return [point for point in points if point.policies >= MIN_SEEDS]


def choose(measure: str, expected: Sequence[Expected]) -> Choice:
    """The agents that are clearly better than `STANDARD`; this one if all are clearly worse.

    Agents of which no record says anything do not count, unless that is so of all.
    """
    expected = [e for e in expected if e.value is not None] or expected
    better = sorted((e for e in expected if e.sign > 0), key=lambda e: -(e.value or 0.0))
    if better:
        return Choice(measure, tuple(e.agent for e in better))
    if expected and all(e.sign < 0 for e in expected):
        return Choice(measure, (STANDARD,))
    if not expected:
        return Choice(measure, (), f"no audited cell has paired runs of a learner and {STANDARD}")
    if any(not e.reasons for e in expected):
        return Choice(measure, (), "no interval lies above 0, and not all lie below it")
    reasons = dict.fromkeys(reason for e in expected for reason in e.reasons)
    return Choice(measure, (), "; ".join(reasons))


def expect(world: AuditedWorld, lines: Lines, known: bool = True) -> Expected:
    """The expectation from one agent's points.

    The first one that may decide something; else the first one, with the reason why it may not.

    Args:
        world: where.
        lines: of the agent.
        known: whether the cells of this task count.
    """
    undecided = []
    for expected in _expectations(world, lines, known):
        if not expected.reasons:
            return expected
        undecided.append(expected)
    nothing = f"no mapped cell is like it: {' or '.join(world.kinds)}"
    return undecided[0] if undecided else Expected(reasons=(nothing,))


def _expectations(world: AuditedWorld, lines: Lines, known: bool) -> Iterator[Expected]:
    if known and (measured := _measured(world, lines)):
        yield measured
    for own in (True, False) if known else (False,):
        for kind in world.kinds:
            if line := lines.line(world.task, kind, own):
                yield line.at(world)


def _measured(world: AuditedWorld, lines: Lines) -> Expected | None:
    """From the records of this very cell; of several studies, the mean over them."""
    place = world.task, in_order(world.variant), world.group
    cells = [
        point
        for point in lines.points
        if (point.table.key.task, in_order(point.table.key.variant), point.table.key.group) == place
    ]
    if not cells:
        return None
    pairs = [list(point.pairs.values()) for point in cells]
    interval = stratified_bootstrap(pairs, lines.resamples)
    policies = max(point.policies for point in cells)
    return Expected(
        value=interval.value,
        interval=interval,
        source="this cell",
        kind=dial_of(world.variant),
        cells=len(cells),
        policies=policies,
        tasks=1,
        reasons=_too_few(policies),
    )


def _too_few(policies: int) -> tuple[str, ...]:
    return () if policies >= MIN_SEEDS else (f"base policies: {policies}, {MIN_SEEDS} are needed",)


@dataclass(frozen=True)
class _Level:
    """The mean over base policies of a setting: of the defect, of the advantage, of each cell."""

    task: str
    defect: float
    drawn: Array
    advantage: BootstrapEstimate
    cells: list[tuple[float, float]]
    policies: set[str]


@dataclass(frozen=True)
class _Line:
    """A line in the defect, at the mean level of some tasks.

    Attributes:
        kind: of the cells that it goes through, beside the unbroken ones.
        own: whether its level is that of the world's own task.
        levels: of the settings whose mean level it has, each task with the same weight.
        cells: that it goes through.
        slope: of the advantage; 0 through unbroken cells alone.
        spread, freedom: standard deviation of a cell around it, and its degrees of freedom.
        defects: the smallest and the largest.
        dials: those of its broken cells.
    """

    kind: str
    own: bool
    levels: list[_Level]
    weights: list[float]
    cells: int
    slope: BootstrapEstimate
    spread: float
    freedom: int
    defects: tuple[float, float]
    dials: set[str]

    @property
    def tasks(self) -> set[str]:
        return {level.task for level in self.levels}

    @property
    def policies(self) -> set[str]:
        return {policy for level in self.levels for policy in level.policies}

    def reasons(self, world: AuditedWorld) -> Iterator[str]:
        """Why it decides nothing; none if it may."""
        yield from _too_few(len(self.policies))
        if self.own and self.freedom < LEAST_FREEDOM:
            yield "too few cells to say how far they lie from their line"
        if self.kind.startswith(PART) and len(self.dials) < LEAST_DIALS:
            yield f"mapped dials of {self.kind}: {len(self.dials)}, {LEAST_DIALS} are needed"
        if not self.own and len(self.tasks) < LEAST_TASKS:
            yield f"other tasks with such cells: {len(self.tasks)}, {LEAST_TASKS} are needed"
        low, high = self.defects
        if world.defect.interval.low > high or world.defect.interval.high < low:
            yield f"its defect lies beyond those of the map, {low:.2f} to {high:.2f}"

    def at(self, world: AuditedWorld) -> Expected:
        """What it says of a world."""
        x, pairs = world.defect.value, list(zip(self.weights, self.levels, strict=True))
        resamples = len(self.slope.episodes)
        centre = sum(w * level.defect for w, level in pairs)
        parts = [*(level.advantage for level in self.levels), self.slope]
        line = combined(parts, [*self.weights, x - centre])
        # What the uncertainty of the audits changes, beside the slope's draws.
        moved = world.defect.draw(resamples, np.random.default_rng(1)) - x
        moved = moved - np.sum([w * (level.drawn - level.defect) for w, level in pairs], axis=0)
        line = replace(line, episodes=line.episodes + self.slope.value * moved)
        interval = None
        if self.freedom > 0:
            away = np.random.default_rng(2).standard_t(self.freedom, resamples)
            interval = percentile(line.value, line.draws() + self.spread * away)
        return Expected(
            value=line.value,
            interval=interval,
            source="this task" if self.own else "other tasks",
            kind=self.kind,
            cells=self.cells,
            policies=len(self.policies),
            tasks=len(self.tasks),
            reasons=tuple(self.reasons(world)),
        )


class Lines:
    """The points of one agent in one measure, and the lines through them, each fitted once."""

    def __init__(self, points: Sequence[Point], resamples: int = RESAMPLES) -> None:
        self.points = points
        self.resamples = resamples
        self._fitted: dict[tuple[str, str, bool], _Line | None] = {}

    def line(self, task: str, kind: str, own: bool) -> _Line | None:
        """The line through the cells of one kind and the unbroken ones; None without such cells.

        Args:
            task: of the world.
            kind: of break; `none` for the level of the unbroken cells alone.
            own: at the level of this task, with the slope of all; else without any of its cells.
        """
        place = task, kind, own
        if place not in self._fitted:
            self._fitted[place] = self._fit(task, kind, own)
        return self._fitted[place]

    def _fit(self, task: str, kind: str, own: bool) -> _Line | None:
        chosen = [
            point
            for point in self.points
            if (own or point.table.key.task != task)
            and (point.dial in (UNBROKEN, kind) or PART + point.defect.part == kind)
        ]
        settings = steered(chosen, 1 if kind == UNBROKEN else 2)
        at = {key: units for key, units in settings.items() if not own or key.task == task}
        if not at:
            return None
        others = {key: units for key, units in settings.items() if key not in at}
        levels = self._levels(at, chosen)
        every = levels + self._levels(others, chosen)
        fitted = None if kind == UNBROKEN else fit(chosen, self.resamples)
        slope = fitted.slope if fitted else combined([levels[0].advantage], [0.0])
        tasks = [level.task for level in levels]
        weights = [1 / len(set(tasks)) / tasks.count(task) for task in tasks]
        cells = sum(len(level.cells) for level in every)
        if own:
            # How far cells lie from the lines of their settings.
            freedom = cells - len(every) - (kind != UNBROKEN)
            number = sum(len(level.cells) for level in levels)
            squares = [
                (y - level.advantage.value - slope.value * (x - level.defect)) ** 2
                for level in every
                for x, y in level.cells
            ]
        else:
            # How far the cells of a task lie from the line of all tasks, as a mean over its cells.
            number, freedom = len(set(tasks)), len(set(tasks)) - 1
            squares = _by_task(levels, weights, slope.value)
        spread = math.sqrt(sum(squares) / freedom) if freedom > 0 else 0.0
        defects = [defect for level in every for defect, _ in level.cells]
        return _Line(
            kind=kind,
            own=own,
            levels=levels,
            weights=weights,
            cells=cells,
            slope=slope,
            spread=spread * math.sqrt(1 + 1 / number),
            freedom=freedom,
            defects=(min(defects), max(defects)),
            dials={point.dial for point in chosen} - {UNBROKEN},
        )

    def _levels(self, settings: dict[Key, list[Unit]], points: Sequence[Point]) -> list[_Level]:
        """The levels of settings, drawn together."""
        if not settings:
            return []
        defects = np.array([point.defect.value for point in points])
        drawn = drawn_defects(points, self.resamples)
        means = cell_estimates(
            [[Sample.mean(list(unit.values())) for unit in units] for units in settings.values()],
            resamples=self.resamples,
        )
        return [
            _Level(
                task=key.task,
                defect=float(np.mean([defects[list(unit)].mean() for unit in units])),
                drawn=np.mean([drawn[list(unit)].mean(axis=0) for unit in units], axis=0),
                advantage=advantage,
                cells=[
                    (
                        float(defects[i]),
                        float(np.mean([unit[i].value for unit in units if i in unit])),
                    )
                    for i in sorted({i for unit in units for i in unit})
                ],
                policies={sample.policy for unit in units for sample in unit.values()},
            )
            for (key, units), advantage in zip(settings.items(), means, strict=True)
        ]


def _by_task(levels: Sequence[_Level], weights: Sequence[float], slope: float) -> list[float]:
    """The mean square distance of each task's cells from the line of all tasks."""
    height = sum(
        w * (level.advantage.value - slope * level.defect)
        for w, level in zip(weights, levels, strict=True)
    )
    squares: dict[str, list[float]] = defaultdict(list)
    for level in levels:
        squares[level.task] += [(y - height - slope * x) ** 2 for x, y in level.cells]
    return [float(np.mean(of_task)) for of_task in squares.values()]
