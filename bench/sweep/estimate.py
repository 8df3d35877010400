"""How long runs take, guessed from those that are finished and those that are under way."""

from __future__ import annotations

import statistics
from collections import defaultdict
from collections.abc import Iterable, Mapping
from typing import Any

from symsteer.agents import AGENTS
from symsteer.bench.sweep.plan import Cell

Progress = Mapping[str, Any]
"""What a running run says of itself (``symsteer.bench.runs.folder.read_progress``)."""


class Estimate:
    """Seconds of a run: the median of the most similar finished ones, scaled with the budget."""

    def __init__(self) -> None:
        self.runs = 0
        """How many finished runs it knows."""
        self._rates: dict[tuple, list[float]] = defaultdict(list)

    def add(self, cell: Cell, seconds: float) -> None:
        """A finished run took this long."""
        self.runs += 1
        for key in _keys(cell):
            self._rates[key].append(seconds / cell.env_steps)

    def left(
        self, todo: Iterable[Cell], running: Mapping[Cell, Progress | None], workers: int
    ) -> float | None:
        """Seconds until all is done; None where nothing is known yet.

        Args:
            todo: cells that are not running.
            running: those that are, with what they say of themselves.
            workers: runs side by side.
        """
        # An agent of which no run is finished is judged by those that are under way.
        going: dict[tuple, list[float]] = defaultdict(list)
        for cell, progress in running.items():
            if progress and progress.get("steps_per_second"):
                for key in _keys(cell):
                    going[key].append(1 / progress["steps_per_second"])
        parts = [(cell, 1.0) for cell in todo]
        parts += [(cell, 1 - share_done(progress)) for cell, progress in running.items()]
        seconds = []
        for cell, share in parts:
            rates = _nearest(cell, self._rates) or _nearest(cell, going)
            if not rates:
                return None
            seconds.append(statistics.median(rates) * cell.env_steps * share)
        # No number of workers is faster than the longest run.
        return max(sum(seconds) / max(workers, 1), max(seconds, default=0.0))


def share_done(progress: Progress | None) -> float:
    """The share of its budget that a run has behind it."""
    if not progress or not progress.get("budget"):
        return 0.0
    return min(progress["env_steps"] / progress["budget"], 1.0)


def duration(seconds: float) -> str:
    """A length of time as one says it: 40 s, 12 min, 3.5 h, 2.1 days."""
    if seconds < 90:
        return f"{seconds:.0f} s"
    if seconds < 90 * 60:
        return f"{seconds / 60:.0f} min"
    if seconds < 48 * 3600:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 86400:.1f} days"


def _nearest(cell: Cell, rates: Mapping[tuple, list[float]]) -> list[float]:
    """Seconds a step of the most similar runs."""
    return next((rates[key] for key in _keys(cell) if key in rates), [])


def _keys(cell: Cell) -> list[tuple]:
    """From the most to the least similar; an agent that learns is never judged by one that does
    not."""
    agent = AGENTS.get(cell.agent)
    return [
        (cell.task, cell.embodiment, cell.agent, cell.env_steps),
        (cell.task, cell.embodiment, cell.agent),
        (cell.embodiment, cell.agent),
        (cell.agent,),
        (getattr(agent, "learns", None), getattr(agent, "searches", None)),
    ]
