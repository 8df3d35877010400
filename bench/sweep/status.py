"""``symsteer status``: how far the sweeps and runs below a folder are."""

from __future__ import annotations

import os
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from symsteer.bench.runs.folder import CONFIG, read_config
from symsteer.bench.sweep.plan import BASIC, PART, PlannedRun, read_sweep, sweep_path, title
from symsteer.bench.sweep.slurm import jobs_left
from symsteer.bench.sweep.survey import Sighting, duration, look, time_left
from symsteer.errors import UserError
from symsteer.names import unknown
from symsteer.terminal import to_paste

STATES = ("finished", "running", "interrupted", "failed", "missing")
IN_SLURM = ("queued", "lost")
"""States of runs that were handed to Slurm and do not run: a job has them, or its job has ended."""


@dataclass(frozen=True)
class Status:
    """The state of a sweep, or of runs without a sweep."""

    title: str
    runs: dict[PlannedRun, Sighting]
    reasons: dict[str, str] = field(default_factory=dict)
    """Why runs failed, by run id."""
    workers: int = 0
    """Number of runs at the same time in the last sweep; 0 if unknown."""
    slurm: dict[str, Path | None] = field(default_factory=dict)
    """Of runs that were handed to Slurm, by run id: None while a job has them, then its output."""
    note: str = ""

    def state(self, run: PlannedRun) -> str:
        """One of :data:`STATES` or :data:`IN_SLURM`."""
        state = self.runs[run].state
        # A killed process could not write that its run failed, but its sweep did.
        if state in ("interrupted", "missing"):
            if run.run_id in self.reasons:
                return "failed"
            if run.run_id in self.slurm:
                return "queued" if self.slurm[run.run_id] is None else "lost"
        return state

    def in_state(self, state: str) -> list[PlannedRun]:
        """The runs in a state."""
        return [run for run in self.runs if self.state(run) == state]


@dataclass(frozen=True)
class Overview:
    """The sweeps and runs below a folder, and the files that cannot be read."""

    sweeps: list[Status] = field(default_factory=list)
    damage: list[UserError] = field(default_factory=list)
    """One for each file that cannot be read."""


def read_status(folder: Path, suite: str | None = None) -> Overview:
    """The sweeps below a folder, at any depth, and the runs without a sweep.

    Args:
        folder: of runs or of folders of runs, or of one run.
        suite: read only the sweeps of this suite.

    Raises:
        UserError: if there is no such folder or sweep, or the given sweep is damaged.
    """
    if not folder.is_dir():
        raise UserError(f"there is no folder {folder}; name the --runs of a sweep or a run")
    if (folder / CONFIG).is_file():
        return Overview([Status("run", _unlisted(folder))])
    runs, files = _search(folder)
    if suite is not None:
        named = [key for key in files if key[1] == suite]
        if not files:
            raise UserError(f"there is no sweep in {folder}; name the --runs of a sweep")
        if not named:
            names = dict.fromkeys(name for _, name in files)
            raise unknown("sweep of a suite", suite, names, str(folder))
        return Overview([_of_sweep(folder, *key, files[key]) for key in named])
    overview = Overview()
    for key, paths in files.items():
        try:
            overview.sweeps.append(_of_sweep(folder, *key, paths))
        except UserError as error:
            overview.damage.append(error)
    listed = {run.run_id for status in overview.sweeps for run in status.runs}
    others: dict[PlannedRun, Sighting] = {}
    for path in runs:
        if path.name not in listed:
            try:
                others |= _unlisted(path)
            except UserError as error:
                overview.damage.append(error)
    if others:
        overview.sweeps.append(Status("runs of no sweep" if overview.sweeps else "runs", others))
    return overview


def _search(folder: Path) -> tuple[list[Path], dict[tuple[Path, str], list[Path]]]:
    """Folders of runs and files of sweeps below a folder; hidden folders are left out.

    The files of sweeps are grouped by folder of the runs and suite: shares have their own.
    """
    runs: list[Path] = []
    sweeps: dict[tuple[Path, str], list[Path]] = defaultdict(list)
    for parent, names, files in os.walk(folder):
        names[:] = sorted(name for name in names if not name.startswith("."))
        path = Path(parent)
        if CONFIG in files:
            runs.append(path)
            names.clear()
        for file in sorted(sweep_path(path, "*").parent.glob("*.json")):
            sweeps[path, PART.sub("", file.stem)].append(file)
    return runs, sweeps


def _unlisted(folder: Path) -> dict[PlannedRun, Sighting]:
    """A run that no sweep lists; nothing if the configuration is not one of SymSteer."""
    config = read_config(folder)
    if all(isinstance(config.get(key), str | int) for key in (*BASIC, "env_steps")):
        return {PlannedRun.of(config, folder.resolve().name): look(folder)}
    return {}


def _of_sweep(folder: Path, out: Path, suite: str, paths: Sequence[Path]) -> Status:
    """The sweep of a suite, from its files; the title has its path below ``folder``."""
    whole = sweep_path(out, suite)
    # The list of the whole suite replaces what was written before it.
    files = sorted(
        ((read_sweep(path), path) for path in paths),
        key=lambda pair: (pair[0].updated, pair[1] != whole),
    )
    runs: dict[str, PlannedRun] = {}
    reasons: dict[str, str] = {}
    jobs: dict[str, str] = {}
    for sweep, path in files:
        if path == whole:
            runs, reasons, jobs = {}, {}, sweep.jobs
        mine = {run.run_id: run for run in sweep.runs}
        runs |= mine
        reasons = {key: reasons[key] for key in reasons.keys() - mine} | sweep.failures
    name = title(sweep.suite, sweep.description)
    name = name if out == folder else f"{out.relative_to(folder)}: {name}"
    seen = {run: look(out / run.run_id) for run in runs.values()}
    status = Status(name, seen, reasons, sweep.workers)
    if not jobs or all(sighting.state == "finished" for sighting in seen.values()):
        return status
    try:
        return replace(status, slurm=jobs_left(out, suite, jobs))
    except UserError as error:
        return replace(status, note=f"queued and lost runs are not known: {error}")


def to_text(sweeps: list[Status], folder: Path) -> str:
    """:attr:`Overview.sweeps` as text."""
    if not sweeps:
        start = to_paste("symsteer", "sweep", "SUITE", "--runs", folder)
        return f"there are no runs in {folder} yet; start some: {start}"
    return "\n\n".join(_text(status) for status in sweeps)


def _text(status: Status) -> str:
    lines = [f"{status.title} ({len(status.runs)} runs)"]
    counts = Counter(status.state(run) for run in status.runs)
    shown = [*STATES, *(IN_SLURM if status.slurm else ())]
    lines += [f"  {state:12s}{counts[state]:6d}" for state in shown]
    lines += [status.note] if status.note else []
    for state in ("running", "interrupted", "failed", "lost"):
        if runs := status.in_state(state):
            lines.append(f"{state}:")
            lines += [f"  {run.label}: {_detail(status, run)}" for run in runs]
    if counts["finished"] < len(status.runs):
        workers = counts["running"] or status.workers or 1
        left = time_left(status.runs, workers)
        lines.append(
            "time left: unknown, no similar run is finished yet"
            if left is None
            else f"time left: about {duration(left)} with {workers} "
            f"worker{'s' if workers > 1 else ''}" + ("" if counts["running"] else "; none runs now")
        )
    return "\n".join(lines)


def _detail(status: Status, run: PlannedRun) -> str:
    """Details of a run that is not finished."""
    sighting, state = status.runs[run], status.state(run)
    if state == "failed":
        return status.reasons.get(run.run_id) or sighting.failure or "no reason is recorded"
    if state == "lost":
        output = status.slurm[run.run_id]
        return f"its Slurm job has ended; the same command queues it again (output: {output})"
    if state == "interrupted":
        done = min(sighting.env_steps, run.env_steps)
        return f"after {done:,} of {run.env_steps:,} steps; it continues from its last checkpoint"
    return sighting.doing()
