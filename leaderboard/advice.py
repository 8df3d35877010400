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

from symsteer.leaderboard.defects import (
    MEASURES,
    Audit,
    Defect,
    Point,
    Unit,
    dial_of,
    drawn_defects,
    fit,
    in_order,
    points_of,
    steered,
)
from symsteer.leaderboard.paper import STANDARD
from symsteer.leaderboard.statistics import (
    RESAMPLES,
    Array,
    Estimate,
    Interval,
    Sample,
    cell_estimates,
    combined,
    crossed_bootstrap,
    percentile,
)
from symsteer.leaderboard.summary import MIN_SEEDS, Key, Summary, row_place
from symsteer.variant import UNBROKEN

LEAST_TASKS = 3
"""Other tasks that an expectation for a new one needs."""

LEAST_FREEDOM = 2
"""Degrees of freedom that the distance of cells from their line needs."""

LEAST_DIALS = 2
"""Dials that the line of a part needs: how much dials differ cannot be known from one."""

RESAMPLES_LEFT_OUT = 1000

PART = "part "
"""Begins the name of a kind of break that is a part of the defect, not a dial."""

Source = Literal["this cell", "this task", "other tasks", ""]


@dataclass(frozen=True)
class World:
    """A place on the map: where an agent is wanted."""

    task: str
    embodiment: str
    variant: str
    group: str
    defect: Defect

    @property
    def kinds(self) -> list[str]:
        """How it is broken, the narrowest first: by its dial, by the part of its defect."""
        dial = dial_of(self.variant)
        return [UNBROKEN] if dial == UNBROKEN else [dial, PART + self.defect.part]

    @classmethod
    def of(cls, point: Point) -> World:
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

    value: float | None
    interval: Interval | None
    source: Source
    kind: str
    cells: int
    policies: int
    tasks: int
    reasons: tuple[str, ...]
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
    reason: str


@dataclass(frozen=True)
class Advice:
    """What the records say about a world."""

    world: World
    expected: tuple[Expected, ...]
    choices: tuple[Choice, ...]


@dataclass(frozen=True)
class LeftOut:
    """How an agent's expectations were, in cells of tasks that they knew nothing of.

    Attributes:
        cells: with an expectation and a measured advantage.
        right: in which both have the same sign.
        clear, clear_right: the same of cells whose measured interval excludes 0.
        inside: in which the interval holds the measured advantage, of those `with_interval`.
        error: mean absolute error.
    """

    agent: str
    measure: str
    cells: int
    right: int
    clear: int
    clear_right: int
    with_interval: int
    inside: int
    error: float


@dataclass(frozen=True)
class BestLeftOut:
    """In how many cells of left-out tasks the expected best agent was the best one.

    `usual` is the same of the agent that is best on average over the cells of the other tasks.
    """

    measure: str
    cells: int
    right: int
    usual: int


@dataclass(frozen=True)
class LeaveOut:
    """The map, tested by leaving out one task after the other, in one embodiment."""

    embodiment: str
    tasks: tuple[str, ...]
    agents: tuple[LeftOut, ...]
    best: tuple[BestLeftOut, ...]


def advise(summaries: Sequence[Summary], audit: Audit, world: World) -> Advice:
    """What to expect of each learner in a world, and which one to take.

    Args:
        summaries: of the records of each study; runs are paired within one.
        audit: their defects.
        world: where.
    """
    expected = []
    for agent in _agents(summaries):
        for measure in MEASURES:
            if points := _points(summaries, audit, world.embodiment, agent, measure):
                found = expect(world, Lines(points))
                expected.append(replace(found, agent=agent, measure=measure))
    choices = tuple(choose(m, [e for e in expected if e.measure == m]) for m in MEASURES)
    return Advice(world, tuple(expected), choices)


def choose(measure: str, expected: Sequence[Expected]) -> Choice:
    """The agents that are clearly better than `STANDARD`; this one if all are clearly worse.

    Agents of which no record says anything do not count, unless that is so of all.
    """
    expected = [e for e in expected if e.value is not None] or expected
    better = sorted((e for e in expected if e.sign > 0), key=lambda e: -(e.value or 0.0))
    if better:
        return Choice(measure, tuple(e.agent for e in better), "")
    if expected and all(e.sign < 0 for e in expected):
        return Choice(measure, (STANDARD,), "")
    if not expected:
        return Choice(measure, (), f"no audited cell has paired runs of a learner and {STANDARD}")
    if any(not e.reasons for e in expected):
        return Choice(measure, (), "no interval lies above 0, and not all lie below it")
    reasons = dict.fromkeys(reason for e in expected for reason in e.reasons)
    return Choice(measure, (), "; ".join(reasons))


def expect(world: World, lines: Lines, known: bool = True) -> Expected:
    """The expectation from one agent's points.

    The first one that may decide something; else the first one, with the reason why it may not.

    Args:
        world: where.
        lines: of the agent.
        known: whether the cells of this task count.
    """
    found = []
    for one in _expectations(world, lines, known):
        if not one.reasons:
            return one
        found.append(one)
    nothing = f"no mapped cell is like it: {' or '.join(world.kinds)}"
    return found[0] if found else Expected(None, None, "", "", 0, 0, 0, (nothing,))


def _expectations(world: World, lines: Lines, known: bool) -> Iterator[Expected]:
    if known and (measured := _measured(world, lines)):
        yield measured
    for own in (True, False) if known else (False,):
        for kind in world.kinds:
            if line := lines.line(world.task, kind, own):
                yield line.at(world)


def _measured(world: World, lines: Lines) -> Expected | None:
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
    interval = combined(cell_estimates(pairs, resamples=lines.resamples)).interval()
    policies = max(point.policies for point in cells)
    return Expected(
        *(interval.value, interval, "this cell", dial_of(world.variant)),
        *(len(cells), policies, 1, _too_few(policies)),
    )


def _too_few(policies: int) -> tuple[str, ...]:
    return () if policies >= MIN_SEEDS else (f"base policies: {policies}, {MIN_SEEDS} are needed",)


@dataclass(frozen=True)
class _Level:
    """The mean over base policies of a setting: of the defect, of the advantage, of each cell."""

    key: Key
    defect: float
    drawn: Array
    advantage: Estimate
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
    slope: Estimate
    spread: float
    freedom: int
    defects: tuple[float, float]
    dials: set[str]

    @property
    def tasks(self) -> set[str]:
        return {level.key.task for level in self.levels}

    @property
    def policies(self) -> set[str]:
        return {policy for level in self.levels for policy in level.policies}

    @property
    def reasons(self) -> list[str]:
        """Why it decides nothing; none if it may."""
        found = [*_too_few(len(self.policies))]
        if self.own and self.freedom < LEAST_FREEDOM:
            found.append("too few cells to say how far they lie from their line")
        if self.kind.startswith(PART) and len(self.dials) < LEAST_DIALS:
            found.append(
                f"mapped dials of {self.kind}: {len(self.dials)}, {LEAST_DIALS} are needed"
            )
        if not self.own and len(self.tasks) < LEAST_TASKS:
            found.append(
                f"other tasks with such cells: {len(self.tasks)}, {LEAST_TASKS} are needed"
            )
        return found

    def at(self, world: World) -> Expected:
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
        reasons, (low, high) = self.reasons, self.defects
        if world.defect.interval.low > high or world.defect.interval.high < low:
            reasons.append(f"its defect lies beyond those of the map, {low:.2f} to {high:.2f}")
        source: Source = "this task" if self.own else "other tasks"
        return Expected(
            *(line.value, interval, source, self.kind),
            *(self.cells, len(self.policies), len(self.tasks), tuple(reasons)),
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
        slope = fitted.slope if fitted else _flat(levels[0].advantage)
        tasks = [level.key.task for level in levels]
        weights = [1 / len(set(tasks)) / tasks.count(task) for task in tasks]
        cells = [len(level.cells) for level in every]
        if own:
            freedom = sum(cells) - len(every) - (kind != UNBROKEN)
            spread = _around_own_lines(every, slope.value, freedom)
            number = sum(len(level.cells) for level in levels)
        else:
            number, freedom = len(set(tasks)), len(set(tasks)) - 1
            spread = _around_common_line(levels, weights, slope.value, freedom)
        defects = [defect for level in every for defect, _ in level.cells]
        return _Line(
            *(kind, own, levels, weights, sum(cells), slope),
            *(spread * math.sqrt(1 + 1 / number), freedom, (min(defects), max(defects))),
            {point.dial for point in chosen} - {UNBROKEN},
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
        levels = []
        for (key, units), advantage in zip(settings.items(), means, strict=True):
            cells = [
                (float(defects[i]), float(np.mean([unit[i].value for unit in units if i in unit])))
                for i in sorted({i for unit in units for i in unit})
            ]
            centres = [defects[list(unit)].mean() for unit in units]
            moved = np.mean([drawn[list(unit)].mean(axis=0) for unit in units], axis=0)
            policies = {sample.policy for unit in units for sample in unit.values()}
            levels.append(_Level(key, float(np.mean(centres)), moved, advantage, cells, policies))
        return levels


def _flat(like: Estimate) -> Estimate:
    """The slope 0."""
    nothing = np.zeros_like(like.episodes)
    return Estimate(0.0, nothing, nothing, like.freedom)


def _around_own_lines(levels: Sequence[_Level], slope: float, freedom: int) -> float:
    """Standard deviation of cells around the lines of their settings."""
    squares = [
        (y - level.advantage.value - slope * (x - level.defect)) ** 2
        for level in levels
        for x, y in level.cells
    ]
    return math.sqrt(sum(squares) / freedom) if freedom > 0 else 0.0


def _around_common_line(
    levels: Sequence[_Level], weights: Sequence[float], slope: float, freedom: int
) -> float:
    """How far the cells of a task lie from the line of all tasks, root mean square over tasks."""
    height = sum(
        w * (level.advantage.value - slope * level.defect)
        for w, level in zip(weights, levels, strict=True)
    )
    squares: dict[str, list[float]] = defaultdict(list)
    for level in levels:
        squares[level.key.task] += [(y - height - slope * x) ** 2 for x, y in level.cells]
    total = sum(float(np.mean(own)) for own in squares.values())
    return math.sqrt(total / freedom) if freedom > 0 else 0.0


# The test: what would have been expected without a task's own cells.


def leave_tasks_out(summaries: Sequence[Summary], audit: Audit, embodiment: str) -> LeaveOut:
    """Expect every cell from the other tasks alone, and compare with what was measured there.

    Of cells with enough base policies.
    """
    rows, best = [], []
    names: set[str] = set()
    for measure in MEASURES:
        by_agent = {
            agent: points
            for agent in _agents(summaries)
            if (points := _decisive(_points(summaries, audit, embodiment, agent, measure)))
        }
        cells: dict[tuple[int, Key], dict[str, tuple[Expected, float]]] = {}
        for agent, points in by_agent.items():
            lines = Lines([_collapsed(point) for point in points], RESAMPLES_LEFT_OUT)
            found = [
                (point, one)
                for point in points
                if (one := expect(World.of(point), lines, known=False)).value is not None
            ]
            names |= {point.table.key.task for point in points}
            if found:
                rows.append(_left_out(agent, measure, found))
            for point, one in found:
                place = id(point.table), point.table.key
                cells.setdefault(place, {})[agent] = one, _value(point)
        if cells:
            best.append(_best_left_out(measure, cells, by_agent))
    return LeaveOut(embodiment, tuple(sorted(names)), tuple(rows), tuple(best))


def _collapsed(point: Point) -> Point:
    """A point without its episodes: that they are a sample matters far less than what tasks and
    base policies differ in."""
    pairs = {pair: Sample.constant(s.value, s.policy) for pair, s in point.pairs.items()}
    return replace(point, pairs=pairs)


def _value(point: Point) -> float:
    """The measured advantage: the mean over base policies."""
    return crossed_bootstrap(list(point.pairs.values()), resamples=1).value


def _left_out(agent: str, measure: str, found: Sequence[tuple[Point, Expected]]) -> LeftOut:
    pairs = [
        (one, crossed_bootstrap(list(point.pairs.values()), resamples=RESAMPLES_LEFT_OUT))
        for point, one in found
    ]
    values = [(one.value or 0.0, measured) for one, measured in pairs]
    right = [np.sign(value) == np.sign(measured.value) for value, measured in values]
    clear = [measured.sign != 0 for _, measured in values]
    held = [
        one.interval.low <= measured.value <= one.interval.high
        for one, measured in pairs
        if one.interval
    ]
    return LeftOut(
        *(agent, measure, len(values), sum(map(int, right)), sum(clear)),
        sum(int(r) for r, c in zip(right, clear, strict=True) if c),
        *(len(held), sum(held)),
        float(np.mean([abs(value - measured.value) for value, measured in values])),
    )


def _best_left_out(
    measure: str,
    cells: dict[tuple[int, Key], dict[str, tuple[Expected, float]]],
    by_agent: dict[str, list[Point]],
) -> BestLeftOut:
    right = usual = 0
    for (_, key), agents in cells.items():
        measured = {agent: value for agent, (_, value) in agents.items()}
        expected = {agent: one.value or 0.0 for agent, (one, _) in agents.items()}
        average = {
            agent: float(
                np.mean([_value(p) for p in by_agent[agent] if p.table.key.task != key.task])
            )
            for agent in agents
        }
        best = _best(measured)
        right += _best(expected) == best
        usual += _best(average) == best
    return BestLeftOut(measure, len(cells), right, usual)


def _best(advantages: dict[str, float]) -> str:
    """The agent with the largest advantage; `STANDARD` if none is above 0."""
    return max({STANDARD: 0.0} | advantages, key=lambda agent: advantages.get(agent, 0.0))


def _agents(summaries: Sequence[Summary]) -> list[str]:
    roles = {agent: role for summary in summaries for agent, role in summary.roles.items()}
    learners = [agent for agent, role in roles.items() if role == "learner" and agent != STANDARD]
    return sorted(learners, key=lambda agent: row_place(agent, "learner"))


def _points(
    summaries: Sequence[Summary], audit: Audit, embodiment: str, agent: str, measure: str
) -> list[Point]:
    """Those with enough base policies; if there are none, all of them, which decide nothing."""
    found = [p for s in summaries for p in points_of(s, audit, embodiment, agent, measure)]
    return _decisive(found) or found


def _decisive(points: Sequence[Point]) -> list[Point]:
    return [point for point in points if not _too_few(point.policies)]
