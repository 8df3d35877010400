"""Rows, tables and the summary of a leaderboard: what the sections show."""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from operator import attrgetter
from statistics import fmean

import numpy as np

from symsteer.leaderboard.keys import Key
from symsteer.leaderboard.known_agents import row_place
from symsteer.leaderboard.records import Divergence, Role
from symsteer.leaderboard.records.reproductions import Verdict
from symsteer.leaderboard.runs import Run
from symsteer.leaderboard.statistics import Interval, censored_median

MIN_SEEDS = 5
"""Finished runs, or pairs of runs, that a rank and a verdict need."""


@dataclass
class AgentRow:
    """An agent (one recipe of it) in one table; `row_numbers` fills in the numbers."""

    agent: str
    role: Role
    recipe: str
    runs: list[Run]
    missing: int = 0
    marked: bool = False
    """Whether its runs are submitted ones that no maintainer has reproduced."""
    label: str = ""
    usual: bool = False
    """Whether most runs of the agent, in all tables, have the settings of this row."""
    success: Interval | None = None
    last: Interval | None = None
    difference: Interval | None = None
    """From the base policy."""
    against_best: Interval | None = None
    """Difference from the best reference."""
    pairs_with_best: int = 0
    rise: Interval | None = None
    area: float | None = None
    threshold_steps: list[int | None] = field(default_factory=list)
    dip: float | None = None
    rank: int | None = None

    @property
    def finished(self) -> list[Run]:
        return [run for run in self.runs if run.finished]

    def by_policy(self, measure: str | Callable[[Run], float | None]) -> dict[str, float]:
        """A measure of the finished runs that have it, mean over the runs on each base policy."""
        of = attrgetter(measure) if isinstance(measure, str) else measure
        values: dict[str, list[float]] = defaultdict(list)
        for run in self.finished:
            if (value := of(run)) is not None:
                values[run.policy].append(value)
        return {policy: fmean(of_runs) for policy, of_runs in values.items()}

    @property
    def is_reference(self) -> bool:
        """Whether it is compared with and never ranked."""
        return self.role == "reference"

    @property
    def episodes(self) -> list[int]:
        """Episodes in the final window of each finished run."""
        return [len(run.window) for run in self.finished]

    @property
    def search_steps(self) -> float | None:
        """Mean environment steps that a reference spent on search; None if it spent none."""
        if not self.is_reference or not self.finished:
            return None
        return float(np.mean([run.record.budget.env_steps for run in self.finished])) or None

    @property
    def median_threshold_steps(self) -> float | None:
        return censored_median(self.threshold_steps) if self.threshold_steps else None

    @property
    def divergences(self) -> list[Divergence]:
        """How far Q left what is feasible, for every run with a critic, finished or not."""
        return [run.record.divergence for run in self.runs if run.record.divergence]

    @property
    def diverged(self) -> list[bool]:
        """Whether Q diverged, for the same runs."""
        return [divergence.diverged for divergence in self.divergences]

    @property
    def reproductions(self) -> Counter[Verdict]:
        """Of its runs that were made again: how many for each verdict."""
        return Counter(run.reproduction.verdict for run in self.runs if run.reproduction)

    def over_runs(self, *names: str) -> float | None:
        """Mean over finished runs of a diagnostic's final value."""
        values = [value for run in self.finished if (value := run.last(*names)) is not None]
        return float(np.mean(values)) if values else None

    def largest(self, name: str) -> float | None:
        """Largest value of a part of `Divergence` over the runs that have it."""
        values = [getattr(divergence, name) for divergence in self.divergences]
        return max((value for value in values if value is not None), default=None)


@dataclass
class Table:
    """All rows of one task, embodiment, variant and base policy; marked ones come last."""

    key: Key
    rows: list[AgentRow]
    threshold: float | None = None
    best_reference: AgentRow | None = None

    @property
    def trusted(self) -> list[AgentRow]:
        """The rows that are not marked: all that is concluded is about them."""
        return [row for row in self.rows if not row.marked]

    @property
    def learners(self) -> list[AgentRow]:
        """Trusted rows with finished runs of agents that are no references."""
        return [row for row in self.trusted if row.finished and not row.is_reference]

    @property
    def decisive(self) -> frozenset[str]:
        """The learners, without controls, with enough base policies for a verdict."""
        names = {row.agent for row in self.learners if row.role == "learner"}
        rows = [row for agent in names if (row := self.row_of(agent))]
        return frozenset(r.agent for r in rows if len(r.by_policy("success")) >= MIN_SEEDS)

    def row_of(self, agent: str) -> AgentRow | None:
        """The agent's trusted row with its usual settings, else that with the most finished runs.

        None if the agent finished none.
        """
        rows = [row for row in self.trusted if row.agent == agent and row.finished]
        return max(rows, key=lambda row: (row.usual, len(row.finished)), default=None)

    def shown(self, agent: str) -> list[AgentRow]:
        """The rows that stand for an agent at a glance: those with its usual settings, or all.

        Marked ones only where there is no other.
        """
        rows = [row for row in self.rows if row.agent == agent]
        rows = [row for row in rows if not row.marked and row.runs] or rows
        return [row for row in rows if row.usual] or rows

    @property
    def runs(self) -> list[Run]:
        return [run for row in self.rows for run in row.runs]

    @property
    def counted(self) -> list[Run]:
        """The runs of trusted rows, or all where there are none."""
        return [run for row in self.trusted for run in row.runs] or self.runs

    @property
    def feasible(self) -> tuple[float, float] | None:
        """The widest feasible Q bounds of the runs, entropy allowance included."""
        bounds = [run.feasible for run in self.counted if run.feasible]
        return (min(low for low, _ in bounds), max(h for _, h in bounds)) if bounds else None

    @property
    def is_ranked(self) -> bool:
        return any(row.rank is not None for row in self.rows)


@dataclass
class Summary:
    """All tables of a leaderboard."""

    tables: list[Table]
    set_aside: list[Run]
    """Older or unfinished records of a configuration, seed and base policy with a better one."""

    @property
    def runs(self) -> list[Run]:
        return [run for table in self.tables for run in table.runs]

    @cached_property
    def version(self) -> str:
        """The day of the newest run, and the beginning of a hash of all records' files."""
        runs = [*self.runs, *self.set_aside]
        newest = max(run.record.ended or run.record.started for run in runs)
        digests = "\n".join(sorted(run.digest for run in runs))
        return f"{newest:%Y-%m-%d}.{hashlib.sha256(digests.encode()).hexdigest()[:8]}"

    @cached_property
    def _usual_budgets(self) -> dict[str, int]:
        """Of each task the budget of most tables; of several, the largest."""
        budgets: dict[str, Counter[int]] = defaultdict(Counter)
        for table in self._trusted_tables:
            budgets[table.key.task][table.key.env_steps] += 1
        return {
            task: max(of_task, key=lambda steps: (of_task[steps], steps))
            for task, of_task in budgets.items()
        }

    def has_usual_budget(self, key: Key) -> bool:
        """Whether most tables of the task have this budget."""
        return key.env_steps == self._usual_budgets.get(key.task)

    @property
    def _trusted_tables(self) -> list[Table]:
        return [table for table in self.tables if any(row.runs for row in table.trusted)]

    @cached_property
    def _demonstrations(self) -> dict[tuple[str, ...], int]:
        """The largest number of demonstrations of each place."""
        # Of each place the largest comes last, and counts.
        return dict(sorted((t.key.place, t.key.demonstrations) for t in self._trusted_tables))

    def has_few_demonstrations(self, key: Key) -> bool:
        """Whether other tables of the same place have more."""
        return key.demonstrations < self._demonstrations.get(key.place, 0)

    @cached_property
    def usual_tables(self) -> list[Table]:
        """Those with the budget of most of their task, and the most demonstrations there."""
        return [
            table
            for table in self.tables
            if self.has_usual_budget(table.key) and not self.has_few_demonstrations(table.key)
        ]

    @property
    def has_reproductions(self) -> bool:
        """Whether any of the runs was made again."""
        return any(run.reproduction for run in self.runs)

    @property
    def has_marks(self) -> bool:
        """Whether any row is marked."""
        return any(row.marked for table in self.tables for row in table.rows)

    @cached_property
    def roles(self) -> dict[str, Role]:
        """Role by agent, in the order of the rows."""
        roles = {row.agent: row.role for table in self.tables for row in table.rows}
        return dict(sorted(roles.items(), key=lambda item: row_place(*item)))

    @property
    def agents(self) -> list[str]:
        return list(self.roles)
