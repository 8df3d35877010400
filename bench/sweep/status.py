"""``symsteer status``: how far the sweeps of a folder are."""

from __future__ import annotations

import difflib
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

from symsteer.bench.runs.folder import CONFIG, read_config
from symsteer.bench.sweep.estimate import Estimate, duration
from symsteer.bench.sweep.plan import BASIC, Manifest, PlannedRun, manifest_path, read_manifest
from symsteer.bench.sweep.survey import Sighting, look
from symsteer.errors import UserError

STATES = ("finished", "running", "interrupted", "failed", "missing")


@dataclass(frozen=True)
class Status:
    """The runs of a sweep, or those of a folder that belong to none."""

    title: str
    runs: dict[PlannedRun, Sighting]
    reasons: dict[str, str] = field(default_factory=dict)
    """Why runs failed, by run id."""
    workers: int = 0
    """Runs that the last sweep had side by side; 0 if that is not known."""

    def state(self, run: PlannedRun) -> str:
        """One of :data:`STATES`."""
        state = self.runs[run].state
        # A run that was killed could not write it down; the sweep that saw it did.
        if state in ("interrupted", "missing") and run.run_id in self.reasons:
            return "failed"
        return state

    def runs(self, state: str) -> list[PlannedRun]:
        """The runs in a state."""
        return [run for run in self.runs if self.state(run) == state]

    def seconds_left(self) -> float | None:
        """Until all is finished, by as many workers as run now; None where nothing is known."""
        estimate = Estimate()
        for run in self.runs("finished"):
            estimate.add(run, self.runs[run].seconds)
        running = self.runs("running")
        todo = [run for run in self.runs if self.state(run) not in ("finished", "running")]
        progress = {run: self.runs[run].progress for run in running}
        return estimate.left(todo, progress, len(running) or self.workers or 1)


@dataclass(frozen=True)
class Overview:
    """What a folder holds: its sweeps and runs, and what of it cannot be read."""

    found: list[Status]
    damage: list[UserError] = field(default_factory=list)
    """One for each file that cannot be read."""


def read_status(folder: Path, suite: str | None = None) -> Overview:
    """The sweeps of a folder, and the runs that belong to none.

    Args:
        folder: of the runs.
        suite: look at the sweep of this suite only.

    Raises:
        UserError: if there is no such folder or sweep, or the one that was named is damaged.
    """
    if not folder.is_dir():
        raise UserError(f"there is no folder {folder}; name the --out of a sweep or a run")
    manifests = {
        path.stem: path for path in sorted(manifest_path(folder, "*").parent.glob("*.json"))
    }
    if suite is not None:
        if suite not in manifests:
            close = difflib.get_close_matches(suite, manifests, n=1) or list(manifests)
            hint = f"there: {', '.join(close)}" if close else "no sweep was begun there"
            raise UserError(f"{folder} holds no sweep of a suite {suite!r}; {hint}")
        return Overview([_of_sweep(folder, read_manifest(manifests[suite]))])
    if (folder / CONFIG).is_file():
        return Overview([Status("run", _unlisted(folder))])
    found: list[Status] = []
    damage: list[UserError] = []
    for path in manifests.values():
        try:
            found.append(_of_sweep(folder, read_manifest(path)))
        except UserError as error:
            damage.append(error)
    listed = {run.run_id for status in found for run in status.runs}
    others: dict[PlannedRun, Sighting] = {}
    for run in [path.parent for path in sorted(folder.glob(f"*/{CONFIG}"))]:
        if run.name not in listed:
            try:
                others |= _unlisted(run)
            except UserError as error:
                damage.append(error)
    if others:
        found.append(Status("runs of no sweep" if found else "runs", others))
    return Overview(found, damage)


def _unlisted(folder: Path) -> dict[PlannedRun, Sighting]:
    """A run that no sweep lists, if it is one of this program."""
    config = read_config(folder)
    if all(isinstance(config.get(key), str | int) for key in (*BASIC, "env_steps")):
        return {PlannedRun.of(config, folder.resolve().name): look(folder)}
    return {}


def to_text(found: list[Status], folder: Path) -> str:
    """The :attr:`Overview.found` of a folder, for reading."""
    if not found:
        return (
            f"there are no runs in {folder} yet; `symsteer sweep SUITE --out {folder}` begins some"
        )
    return "\n\n".join(_text(status) for status in found)


def _of_sweep(folder: Path, manifest: Manifest) -> Status:
    return Status(
        manifest.title,
        {run: look(folder / run.run_id) for run in manifest.runs},
        manifest.failures,
        manifest.workers,
    )


def _text(status: Status) -> str:
    lines = [f"{status.title} ({len(status.runs)} runs)"]
    counts = Counter(status.state(run) for run in status.runs)
    lines += [f"  {state:12s}{counts[state]:6d}" for state in STATES]
    for state in ("running", "interrupted", "failed"):
        if runs := status.runs(state):
            lines.append(f"{state}:")
            lines += [f"  {run.label}: {_detail(status, run)}" for run in runs]
    if counts["finished"] < len(status.runs):
        left = status.seconds_left()
        workers = counts["running"] or status.workers or 1
        lines.append(
            "time left: unknown, no such runs are finished yet"
            if left is None
            else f"time left: about {duration(left)} with {workers} "
            f"worker{'s' if workers > 1 else ''}"
            + ("" if counts["running"] else ", once they run: none does now")
        )
    return "\n".join(lines)


def _detail(status: Status, run: PlannedRun) -> str:
    """What there is to say of a run that is not finished."""
    seen = status.runs[run]
    state = status.state(run)
    if state == "failed":
        own = seen.record.failure if seen.record else None
        return status.reasons.get(run.run_id) or own or "it does not say why"
    if state == "interrupted":
        done = seen.record.budget.env_steps if seen.record else 0
        return f"after {done:,} of {run.env_steps:,} steps; it continues from its last checkpoint"
    progress = seen.progress
    if not progress:
        return "starting"
    words = [f"{progress['env_steps']:,} of {progress['budget']:,} steps"]
    if progress.get("success") is not None:
        words.append(f"success {progress['success']:.0%}")
    if progress.get("steps_per_second"):
        words.append(f"{progress['steps_per_second']:,.0f} steps/s")
    if progress.get("seconds_left") is not None:
        words.append(f"about {duration(progress['seconds_left'])} left")
    return ", ".join(words)
