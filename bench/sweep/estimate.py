"""Estimates of how long runs take, from finished and running ones."""

from __future__ import annotations

import contextlib
import statistics
from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Any

from symsteer.agents import AGENTS
from symsteer.bench.sweep.plan import PlannedRun
from symsteer.errors import UserError

Progress = Mapping[str, Any]
"""What ``symsteer.bench.runs.folder.read_progress`` returns for a running run."""


class Estimate:
    """Seconds of a run: the median of the most similar finished runs, scaled with the budget."""

    def __init__(self) -> None:
        self.runs = 0
        """Number of finished runs that it is based on."""
        self._rates: dict[tuple, list[float]] = defaultdict(list)

    def add(self, run: PlannedRun, seconds: float) -> None:
        """Add the duration of a finished run."""
        self.runs += 1
        for key in _keys(run):
            self._rates[key].append(seconds / run.env_steps)

    def left(
        self,
        todo: Iterable[PlannedRun],
        running: Mapping[PlannedRun, Progress | None],
        workers: int,
    ) -> float | None:
        """Seconds until all runs are finished; None if no run is similar enough to tell.

        Args:
            todo: runs that have not started.
            running: running ones, with their progress.
            workers: number of runs at the same time.
        """
        # For an agent without finished runs, use its running ones.
        going: dict[tuple, list[float]] = defaultdict(list)
        for run, progress in running.items():
            if progress and progress.get("steps_per_second"):
                for key in _keys(run):
                    going[key].append(1 / progress["steps_per_second"])
        parts = [(run, 1.0) for run in todo]
        parts += [(run, 1 - share_done(progress)) for run, progress in running.items()]
        seconds = []
        for run, share in parts:
            rates = _nearest(run, self._rates) or _nearest(run, going)
            if not rates:
                return None
            seconds.append(statistics.median(rates) * run.env_steps * share)
        # The sweep takes at least as long as its longest run.
        return max(sum(seconds) / max(workers, 1), max(seconds, default=0.0))


def share_done(progress: Progress | None) -> float:
    """The share of its budget that a run has used, in [0, 1]."""
    if not progress or not progress.get("budget"):
        return 0.0
    return steps_done(progress) / progress["budget"]


def steps_done(progress: Progress) -> int:
    """Control steps that a run has done, at most its budget.

    The last decision of all environments can go a few steps beyond the budget.
    """
    return min(progress["env_steps"], progress["budget"])


def duration(seconds: float) -> str:
    """A duration as text: 40 s, 12 min, 3.5 h, 2.1 days."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 90 * 60:
        return f"{seconds / 60:.0f} min"
    if seconds < 48 * 3600:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 86400:.1f} days"


def _nearest(run: PlannedRun, rates: Mapping[tuple, list[float]]) -> list[float]:
    """Seconds per step of the most similar runs."""
    return next((rates[key] for key in _keys(run) if key in rates), [])


def _keys(run: PlannedRun) -> list[tuple]:
    """Groups of similar runs, from the most to the least similar.

    All learners take similar times. Other agents are only compared with themselves: a search
    takes much longer than an agent that does nothing.
    """
    keys: list[tuple] = [
        (run.task, run.embodiment, run.agent, run.env_steps),
        (run.task, run.embodiment, run.agent),
        (run.embodiment, run.agent),
        (run.agent,),
    ]
    # The agent may come from a package that is not installed here.
    with contextlib.suppress(UserError):
        if AGENTS.get(run.agent).role == "learner":
            keys.append(("learner",))
    return keys
