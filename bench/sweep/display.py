"""The output of a sweep: a line for each run that has ended; on a terminal, bars for the others."""

from __future__ import annotations

import contextlib
import threading
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from typing import TextIO

from tqdm import tqdm

from symsteer.bench.runs.folder import read_progress
from symsteer.bench.sweep.plan import BASIC, Plan, PlannedRun
from symsteer.bench.sweep.schedule import EndedRun, Task, Watcher
from symsteer.bench.sweep.survey import Sighting, duration, look, time_left
from symsteer.bench.sweep.work import Result

SKEW = timedelta(seconds=5)
"""Largest difference between the clocks of two machines."""

Line = tuple[Task, PlannedRun | None]
"""A task that executes no run, or one of the runs of a task."""


class Display(contextlib.AbstractContextManager, Watcher):
    """Prints one line for each run that ends. A terminal has a bar for each run, and one for all.

    Args:
        plan: of the sweep.
        seen: the states of its runs at the beginning.
        workers: number of runs at the same time; None if the cluster decides.
        output: where to print the lines.
    """

    def __init__(
        self, plan: Plan, seen: dict[PlannedRun, Sighting], workers: int | None, output: TextIO
    ):
        self.out, self.workers, self.output, self.seen = plan.out, workers, output, dict(seen)
        todo = [run for run, sighting in seen.items() if sighting.state != "finished"]
        self.counts = Counter({"finished": len(seen) - len(todo)})
        # The default lock is a system semaphore. A killed process would not remove it.
        tqdm.set_lock(threading.RLock())
        self.begun: dict[Line, datetime] = {}
        self.bars: dict[Line, tqdm] = {}
        self.whole = self._bar(plan.name, len(seen))
        self.labels = {run: run.label for run in todo} if self.whole.disable else _short(todo)

    def __exit__(self, *details: object) -> None:
        for bar in (*self.bars.values(), self.whole):
            bar.close()

    def ended(self, end: EndedRun) -> None:
        """A run has ended."""
        self.counts[end.status] += 1
        detail = end.reason
        if end.status == "finished":
            self.seen[end.run] = sighting = look(self.out / end.run.run_id)
            detail = f"{sighting.success}, {duration(sighting.seconds)}"
        else:
            del self.seen[end.run]  # it is not waited for
        total = self.whole.total
        count = f"[{self.counts.total():{len(str(total))}d}/{total}]"
        width = max(map(len, self.labels.values()))
        self.write(end.status, f"{count} {self.labels[end.run]:{width}s}  {detail}")

    def retried(self, task: Task, result: Result) -> None:
        if not self.whole.disable:
            self.write("again", f"{task.kind} {task.label}: {result.reason}")

    def write(self, status: str, text: str) -> None:
        """Print one line above the bars; a closed pipe does not stop the sweep."""
        with contextlib.suppress(BrokenPipeError), tqdm.external_write_mode(self.output):
            print(f"{status:9s} {text}", file=self.output, flush=True)

    def refresh(self, running: list[Task]) -> None:
        if self.whole.disable:
            return
        lines: list[Line] = [
            (task, run) for task in running for run in (task.runs if task.kind == "run" else [None])
        ]
        for line in self.bars.keys() - set(lines):
            self.bars.pop(line).close()
        self.begun = {line: self.begun.get(line, datetime.now(UTC)) for line in lines}
        for line in lines:
            self._show(*line)
        left = time_left(self.seen, self.workers or len(self.bars))
        words = [f"{self.counts['finished']} of {self.whole.total} runs finished"]
        words += [f"{self.counts['failed']} failed"] if self.counts["failed"] else []
        words.append("time left unknown" if left is None else f"about {duration(left)} left")
        self.whole.n = self.counts.total()
        self.whole.set_description_str(", ".join(words))

    def _show(self, task: Task, run: PlannedRun | None) -> None:
        """Draw the bar of a task, or of one of its runs."""
        line = (task, run)
        if run is None:
            label, total, done = f"{task.kind} {task.label}", None, 0
            text = f"for {duration((datetime.now(UTC) - self.begun[line]).total_seconds())}"
        else:
            self.seen[run] = sighting = self._sighted(run, self.begun[line])
            # On a cluster, tasks without progress wait for a processor.
            if not (self.workers or sighting.progress):
                return
            label, total, text = self.labels[run], run.env_steps, sighting.doing()
            done = round(sighting.share * run.env_steps)
        # Not `or`: a bar without a total has no truth value.
        if line not in self.bars:
            self.bars[line] = self._bar(label, total)
        self.bars[line].n = done
        self.bars[line].set_description_str(f"{label}: {text}")

    def _sighted(self, run: PlannedRun, begun: datetime) -> Sighting:
        """A running run, with its progress unless an earlier process wrote that."""
        progress = read_progress(self.out / run.run_id)
        with contextlib.suppress(KeyError, TypeError, ValueError):
            if progress and datetime.fromisoformat(progress["updated"]) < begun - SKEW:
                progress = None
        return replace(self.seen[run], state="running", progress=progress)

    def _bar(self, label: str, total: int | None = None) -> tqdm:
        # None: none where the output is no terminal.
        form = "{desc} {bar}" if total else "{desc}"
        return tqdm(
            desc=label, total=total, bar_format=form, disable=None, leave=False, dynamic_ncols=True
        )


def _short(runs: Sequence[PlannedRun]) -> dict[PlannedRun, str]:
    """The agent, and the settings in which the runs differ."""
    shared = {key for key in BASIC if len({run.keys[key] for run in runs}) == 1} - {"agent", "seed"}
    labels = {}
    for run in runs:
        order = ("agent", "task", "embodiment", "variant")
        words = [str(run.keys[key]) for key in order if key not in shared]
        words += [f"{key.rpartition('.')[2]}={value}" for key, value in run.extra.items()]
        labels[run] = f"{' '.join(words)} s{run.seed}"
    return labels
