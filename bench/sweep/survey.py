"""The state of a run, read from its folder."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from symsteer.bench.runs.folder import RECORD, State, read_progress, state_of
from symsteer.errors import UserError
from symsteer.leaderboard.records import RunRecord, read_record


@dataclass(frozen=True)
class Sighting:
    """The state of a run, and its record if it has a readable one."""

    state: State
    record: RunRecord | None = None
    progress: Mapping[str, Any] | None = None
    """Of a running run: what :func:`symsteer.bench.runs.folder.read_progress` returns."""

    @property
    def seconds(self) -> float:
        """Wall-clock seconds that the run took."""
        return self.record.wall_clock.total if self.record else 0.0

    @property
    def success(self) -> str:
        """Success of the last evaluation, as text."""
        if not self.record or not self.record.evaluations:
            return "no evaluation"
        last = self.record.evaluations[-1]
        lost = ", Q not finite" if self.record.nonfinite_q else ""
        lost += f", not finite: {found}" if (found := self.record.not_finite) else ""
        return f"success {last.success_once:4.0%} of {len(last.episodes.seed)}{lost}"


def look(folder: Path) -> Sighting:
    """Read the folder of a run."""
    try:
        record = read_record(folder / RECORD)
    except UserError:
        record = None
    if record and record.status == "finished":
        return Sighting("finished", record)
    state = state_of(folder)
    return Sighting(state, record, read_progress(folder) if state == "running" else None)
