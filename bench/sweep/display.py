"""The output of a sweep: a line for each run that has ended; on a terminal, a bar for all runs."""

from __future__ import annotations

import contextlib
import threading
from collections import Counter
from dataclasses import replace
from typing import TextIO

from tqdm import tqdm

from symsteer.bench.runs.folder import read_progress
from symsteer.bench.sweep.plan import Plan, PlannedRun
from symsteer.bench.sweep.schedule import EndedRun, Task, Watcher
from symsteer.bench.sweep.survey import Sighting, duration, look, time_left
from symsteer.bench.sweep.work import Result


class Display(contextlib.AbstractContextManager, Watcher):
    """Prints one line for each run that ends; a terminal has a bar below, for all runs.

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
        self.width = max((len(run.label) for run in todo), default=0)
        # The default lock is a system semaphore. A killed process would not remove it.
        tqdm.set_lock(threading.RLock())
        form = "{desc} {bar}"
        # None: no bar where the output is no terminal.
        how = {"bar_format": form, "disable": None, "leave": False, "dynamic_ncols": True}
        self.bar = tqdm(desc=plan.name, total=len(seen), **how)

    def __exit__(self, *details: object) -> None:
        self.bar.close()

    def ended(self, end: EndedRun) -> None:
        """A run has ended."""
        self.counts[end.status] += 1
        detail = end.reason
        if end.status == "finished":
            self.seen[end.run] = sighting = look(self.out / end.run.run_id)
            detail = f"{sighting.success}, {duration(sighting.seconds)}"
        else:
            del self.seen[end.run]  # it is not waited for
        total = self.bar.total
        count = f"[{self.counts.total():{len(str(total))}d}/{total}]"
        self.write(end.status, f"{count} {end.run.label:{self.width}s}  {detail}")

    def retried(self, task: Task, result: Result) -> None:
        if not self.bar.disable:
            self.write("again", f"{task.kind} {task.label}: {result.reason}")

    def write(self, status: str, text: str) -> None:
        """Print one line above the bar; a closed pipe does not stop the sweep."""
        with contextlib.suppress(BrokenPipeError), tqdm.external_write_mode(self.output):
            print(f"{status:9s} {text}", file=self.output, flush=True)

    def refresh(self, running: list[Task]) -> None:
        if self.bar.disable:
            return
        runs = [run for task in running if task.kind == "run" for run in task.runs]
        for run in runs:
            progress = read_progress(self.out / run.run_id)
            self.seen[run] = replace(self.seen[run], state="running", progress=progress)
        left = time_left(self.seen, self.workers or len(runs))
        words = [f"{self.counts['finished']} of {self.bar.total} runs finished"]
        words += [f"{self.counts['failed']} failed"] if self.counts["failed"] else []
        words += [f"{len(runs)} running"] if runs else []
        words += [f"{task.kind} {task.label}" for task in running if task.kind != "run"]
        words.append("time left unknown" if left is None else f"about {duration(left)} left")
        self.bar.n = self.counts.total()
        self.bar.set_description_str(", ".join(words))
