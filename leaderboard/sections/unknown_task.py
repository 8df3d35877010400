"""Whether the map is right about a task that it does not know: each task is left out in turn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from symsteer.leaderboard.advantage_by_defect import Point, points_of
from symsteer.leaderboard.defects import Audit
from symsteer.leaderboard.known_agents import STANDARD
from symsteer.leaderboard.pairs import MEASURES, SHORT_NAMES
from symsteer.leaderboard.rows import MIN_SEEDS, Summary, Table
from symsteer.leaderboard.sections import Findings, Section, View
from symsteer.leaderboard.statistics import Interval, Sample, crossed_bootstrap
from symsteer.leaderboard.text import code, number, share, table_text
from symsteer.leaderboard.which_agent import (
    AuditedWorld,
    Expected,
    Lines,
    decisive,
    expect,
    learners,
)

LEFT_OUT_RESAMPLES = 1000

EXPLAINED = f"""\
Is the map right about a task that it does not know? Each cell was expected from the other tasks
alone (`symsteer advise`) and compared with what was measured there, in cells with {MIN_SEEDS} base
policies: whether the sign of the advantage was right, also of those cells alone whose measured
interval excludes 0; whether the measured advantage lay inside the expected interval; the mean
absolute error."""


@dataclass(frozen=True)
class AgentLeftOut:
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
    agents: tuple[AgentLeftOut, ...]
    best: tuple[BestLeftOut, ...]


@dataclass(frozen=True)
class _Cell:
    """What was measured of an agent in a cell, and what was expected without the cell's task."""

    table: Table
    measured: Interval
    expected: Expected

    @property
    def is_right(self) -> bool:
        return bool(np.sign(self.expected.value or 0.0) == np.sign(self.measured.value))

    @property
    def is_inside(self) -> bool:
        interval = self.expected.interval
        return interval is not None and interval.low <= self.measured.value <= interval.high

    @property
    def error(self) -> float:
        return abs((self.expected.value or 0.0) - self.measured.value)


def leave_tasks_out(summaries: Sequence[Summary], audit: Audit, embodiment: str) -> LeaveOut:
    """Expect every cell from the other tasks alone, and compare with what was measured there.

    Of cells with enough base policies.
    """
    agents, best, tasks = [], [], set()
    for measure in MEASURES:
        cells_of: dict[str, list[_Cell]] = {}
        for agent in learners(summaries):
            points = [p for s in summaries for p in points_of(s, audit, embodiment, agent, measure)]
            if points := decisive(points):
                cells_of[agent] = _cells(points)
                tasks |= {point.table.key.task for point in points}
        expected = {
            agent: [cell for cell in cells if cell.expected.value is not None]
            for agent, cells in cells_of.items()
        }
        agents += [_of_agent(agent, measure, cells) for agent, cells in expected.items() if cells]
        if any(expected.values()):
            best.append(_best_agents(measure, expected, cells_of))
    return LeaveOut(embodiment, tuple(sorted(tasks)), tuple(agents), tuple(best))


def _cells(points: Sequence[Point]) -> list[_Cell]:
    """Expectations from points without episodes: that these are a sample matters far less than what
    tasks and base policies differ in."""
    collapsed = [
        replace(
            point,
            pairs={pair: Sample.constant(s.value, s.policy) for pair, s in point.pairs.items()},
        )
        for point in points
    ]
    lines = Lines(collapsed, LEFT_OUT_RESAMPLES)
    return [
        _Cell(
            point.table,
            crossed_bootstrap(list(point.pairs.values()), resamples=LEFT_OUT_RESAMPLES),
            expect(AuditedWorld.of(point), lines, known=False),
        )
        for point in points
    ]


def _of_agent(agent: str, measure: str, cells: Sequence[_Cell]) -> AgentLeftOut:
    return AgentLeftOut(
        agent=agent,
        measure=measure,
        cells=len(cells),
        right=sum(cell.is_right for cell in cells),
        clear=sum(cell.measured.sign != 0 for cell in cells),
        clear_right=sum(cell.is_right for cell in cells if cell.measured.sign),
        with_interval=sum(cell.expected.interval is not None for cell in cells),
        inside=sum(cell.is_inside for cell in cells),
        error=float(np.mean([cell.error for cell in cells])),
    )


def _best_agents(
    measure: str, expected: dict[str, list[_Cell]], measured: dict[str, list[_Cell]]
) -> BestLeftOut:
    """How often the best agent was found; `measured` has the cells without expectation, too."""
    tables: dict[int, dict[str, _Cell]] = {}
    for agent, cells in expected.items():
        for cell in cells:
            tables.setdefault(id(cell.table), {})[agent] = cell
    right = usual = 0
    for cells_here in tables.values():
        best = _best({agent: cell.measured.value for agent, cell in cells_here.items()})
        right += best == _best({a: cell.expected.value or 0.0 for a, cell in cells_here.items()})
        elsewhere = {}
        for agent, here in cells_here.items():
            others = [c for c in measured[agent] if c.table.key.task != here.table.key.task]
            elsewhere[agent] = float(np.mean([cell.measured.value for cell in others]))
        usual += best == _best(elsewhere)
    return BestLeftOut(measure, cells=len(tables), right=right, usual=usual)


def _best(advantages: dict[str, float]) -> str:
    """The agent with the largest advantage; `STANDARD` if none is above 0."""
    return max({STANDARD: 0.0} | advantages, key=lambda agent: advantages.get(agent, 0.0))


def scores(test: LeaveOut) -> list[dict[str, str]]:
    """The rows of a table: how the expectations of each agent were."""
    return [
        {
            "Embodiment": code(test.embodiment),
            "Agent": code(row.agent),
            "Advantage in": SHORT_NAMES[row.measure],
            "Sign right": share(row.right, row.cells),
            "Of clear ones": share(row.clear_right, row.clear),
            "Inside": share(row.inside, row.with_interval),
            "Error": number(row.error),
        }
        for row in test.agents
    ]


def best_agents(test: LeaveOut) -> str:
    """How often the expected best agent was the best one, in a sentence."""
    texts = [
        f"by {SHORT_NAMES[best.measure]} in {share(best.right, best.cells)} cells (the agent that "
        f"is best on average elsewhere: {share(best.usual, best.cells)})"
        for best in test.best
    ]
    where = f"{code(test.embodiment)}, {len(test.tasks)} tasks"
    return f"{where}: the expected best agent was the best {', '.join(texts)}."


def render(tests: list[LeaveOut], view: View) -> list[str]:
    """A subsection of the map; empty where no task could be left out."""
    tested = [test for test in tests if test.agents]
    if not tested:
        return []
    table = table_text([row for test in tested for row in scores(test)], left=3)
    heading = "### A task that the map does not know"
    return [heading, EXPLAINED, table, *map(best_agents, tested)]


def of_embodiments(findings: Findings) -> list[LeaveOut]:
    """The test in each embodiment that the records have."""
    embodiments = sorted({table.key.embodiment for table in findings.summary.tables})
    return [leave_tasks_out([findings.summary], findings.audit, name) for name in embodiments]


SECTION = Section("A task that the map does not know", of_embodiments, render)
"""A part of the map's section (`defect_map`), with a heading of its own."""
