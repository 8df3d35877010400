"""The states of runs, read from their folders, and how long the others may take."""

from __future__ import annotations

import contextlib
import functools
import statistics
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from symsteer.agents import AGENTS
from symsteer.bench.runs.folder import RECORD, State, read_progress, state_of
from symsteer.bench.sweep.plan import PlannedRun
from symsteer.errors import UserError
from symsteer.leaderboard.records import read_record


@dataclass(frozen=True)
class Sighting:
    """The state of a run.

    Attributes:
        state: see :func:`symsteer.bench.runs.folder.state_of`.
        seconds: wall-clock time that its record tells of.
        env_steps: control steps that its record tells of.
        success: that of the last evaluation, as text.
        failure: why it failed, if its record says so.
        progress: of a running run, what :func:`symsteer.bench.runs.folder.read_progress` returns.
    """

    state: State
    seconds: float = 0.0
    env_steps: int = 0
    success: str = "no evaluation"
    failure: str | None = None
    progress: Mapping[str, Any] | None = None

    @property
    def share(self) -> float:
        """The share of its budget that a running run has used, in [0, 1]."""
        budget = self.progress and self.progress.get("budget")
        return min(1.0, self.progress["env_steps"] / budget) if self.progress and budget else 0.0

    def doing(self) -> str:
        """What a running run does, in words."""
        progress = self.progress
        if not progress:
            return "starting"
        # The last decision of all environments can go a few steps beyond the budget.
        steps = min(progress["env_steps"], progress["budget"])
        words = [f"{steps:,} of {progress['budget']:,} steps"]
        if progress.get("success") is not None:
            words.append(f"success {progress['success']:.0%}")
        if progress.get("steps_per_second"):
            words.append(f"{progress['steps_per_second']:,.0f} steps/s")
        if progress.get("seconds_left") is not None:
            words.append(f"about {duration(progress['seconds_left'])} left")
        return ", ".join(words)


def look(folder: Path) -> Sighting:
    """Read the folder of a run."""
    try:
        record = read_record(folder / RECORD)
    except UserError:
        record = None
    state = "finished" if record and record.status == "finished" else state_of(folder)
    progress = read_progress(folder) if state == "running" else None
    if record is None:
        return Sighting(state, progress=progress)
    success = "no evaluation"
    if record.evaluations:
        last = record.evaluations[-1]
        success = f"success {last.success_once:4.0%} of {len(last.episodes.seed)}"
        success += ", Q not finite" if record.nonfinite_q else ""
        success += f", not finite: {record.not_finite}" if record.not_finite else ""
    return Sighting(
        state=state,
        seconds=record.wall_clock.total,
        env_steps=record.budget.env_steps,
        success=success,
        failure=record.failure,
        progress=progress,
    )


def time_left(seen: Mapping[PlannedRun, Sighting], workers: int) -> float | None:
    """Seconds until all runs are finished; None if no run is similar enough to tell.

    A run is expected to take the median of the most similar finished runs, or running ones if there
    are none, scaled with the budget.

    Args:
        seen: the states of the runs.
        workers: number of runs at the same time.
    """
    finished: dict[tuple, list[float]] = defaultdict(list)
    running: dict[tuple, list[float]] = defaultdict(list)
    for run, sighting in seen.items():
        for key in _groups(run):
            if sighting.state == "finished":
                finished[key].append(sighting.seconds / run.env_steps)
            elif sighting.progress and sighting.progress.get("steps_per_second"):
                running[key].append(1 / sighting.progress["steps_per_second"])
    medians = [
        {key: statistics.median(values) for key, values in rates.items()}
        for rates in (finished, running)
    ]
    seconds = []
    for run, sighting in seen.items():
        if sighting.state != "finished":
            similar = (known[key] for known in medians for key in _groups(run) if key in known)
            rate = next(similar, None)
            if rate is None:
                return None
            seconds.append(rate * run.env_steps * (1 - sighting.share))
    # The sweep takes at least as long as its longest run.
    return max(sum(seconds) / max(workers, 1), max(seconds, default=0.0))


def duration(seconds: float) -> str:
    """A duration as text: 40 s, 12 min, 3.5 h, 2.1 days."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 90 * 60:
        return f"{seconds / 60:.0f} min"
    if seconds < 48 * 3600:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 86400:.1f} days"


def _groups(run: PlannedRun) -> list[tuple]:
    """Groups of similar runs, from the most to the least similar.

    All learners take similar times. Other agents are only compared with themselves: a search
    takes much longer than an agent that does nothing.
    """
    groups: list[tuple] = [
        (run.task, run.embodiment, run.agent, run.env_steps),
        (run.task, run.embodiment, run.agent),
        (run.embodiment, run.agent),
        (run.agent,),
    ]
    return [*groups, ("learner",)] if _learns(run.agent) else groups


@functools.cache
def _learns(agent: str) -> bool:
    # The agent may come from a package that is not installed here.
    with contextlib.suppress(UserError):
        return AGENTS.get(agent).role == "learner"
    return False
