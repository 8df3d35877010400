"""The output of a sweep: live lines on a terminal, otherwise one plain line per finished run."""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Mapping
from datetime import UTC, datetime, timedelta
from typing import Any

from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from symsteer.bench.runs.folder import read_progress
from symsteer.bench.sweep.estimate import Estimate, duration, share_done, steps_done
from symsteer.bench.sweep.plan import Plan, PlannedRun, short_labels
from symsteer.bench.sweep.schedule import Outcome, Task, Watcher
from symsteer.bench.sweep.survey import look
from symsteer.bench.sweep.work import Result

BAR, NUMBERS = 20, (15, 4, 11, 6)
"""Widths in columns: of the bar, and of the numbers after it (steps, success, speed, time left)."""

GAP = 2
"""Columns between the parts of a live line."""

SKEW = timedelta(seconds=5)
"""Largest difference between the clocks of two machines."""


class Display(contextlib.AbstractContextManager, Watcher):
    """Prints one line for each run that ends, for logs and pipes.

    Args:
        plan: of the sweep.
        todo: the runs that are not finished.
        estimate: of the time that runs take.
        workers: number of runs at the same time; None if the cluster decides.
        console: where to print.
    """

    def __init__(
        self,
        plan: Plan,
        todo: list[PlannedRun],
        estimate: Estimate,
        workers: int | None,
        console: Console,
    ):
        self.out, self.estimate, self.workers = plan.out, estimate, workers
        self.console = console
        self.waiting = dict.fromkeys(todo)
        self.total = len(plan.runs)
        self.counts = Counter({"finished": self.total - len(todo)})
        self.labels = {run: run.label for run in todo}

    def __exit__(self, *details: object) -> None:
        pass

    def ended(self, outcome: Outcome) -> None:
        """A run has ended."""
        self.waiting.pop(outcome.run, None)
        self.counts[outcome.status] += 1
        detail = outcome.reason
        if outcome.status == "finished":
            seen = look(self.out / outcome.run.run_id)
            self.estimate.add(outcome.run, seen.seconds)
            detail = f"{seen.success}, {duration(seen.seconds)}"
        count = f"[{self.counts.total():{len(str(self.total))}d}/{self.total}]"
        width = max(len(label) for label in self.labels.values())
        self.write(outcome.status, f"{count} {self.labels[outcome.run]:{width}s}  {detail}")

    def write(self, status: str, text: str) -> None:
        """Print one line."""
        # Not with the console, because it wraps lines. A closed pipe does not stop the sweep.
        with contextlib.suppress(BrokenPipeError):
            print(f"{status:9s} {text}", file=self.console.file, flush=True)


class LiveDisplay(Display):
    """For terminals: in addition a live line for each run, and one for the whole sweep."""

    STYLES: Mapping[str, str] = {"finished": "green", "failed": "red"}

    def __init__(self, *args: Any):
        super().__init__(*args)
        todo = list(self.waiting)
        self.room = self.console.width - sum(NUMBERS) - GAP * len(NUMBERS)
        for everything in (True, False):
            self.labels = short_labels(todo, everything)
            self.longest = max((len(label) for label in self.labels.values()), default=0)
            if self.longest <= self.room:
                break
        self.begun: dict[Task, tuple[float, datetime]] = {}
        self.live = Live(console=self.console, transient=True, refresh_per_second=2)

    def __enter__(self) -> LiveDisplay:
        self.live.start()
        return self

    def __exit__(self, *details: object) -> None:
        self.live.stop()

    def started(self, task: Task) -> None:
        self.begun[task] = time.monotonic(), datetime.now(UTC)

    def retried(self, task: Task, result: Result) -> None:
        run = task.team[0] if task.team else None
        self.write("again", f"{self._label(task, run)}: {result.reason}")

    def write(self, status: str, text: str) -> None:
        """Print one line above the live ones."""
        line = Text(f"{status:9s} ", style=self.STYLES.get(status, "yellow"))
        line.append(text, style="default")
        # A long reason is cut; the list at the end of the sweep shows all of it.
        line.truncate(self.console.width, overflow="ellipsis")
        self.console.print(line)

    def refresh(self, running: list[Task]) -> None:
        """Draw the live lines again."""
        lines_of = [(task, run) for task in running for run in task.team or (None,)]
        progress = {line: self._progress(*line) for line in lines_of}
        # On a cluster, tasks without progress wait for a processor.
        shown = [line for line in lines_of if self.workers or progress[line]]
        bars = self.longest + BAR + GAP <= self.room
        table = Table.grid(padding=(0, GAP, 0, 0), expand=True)
        table.add_column(no_wrap=True, overflow="ellipsis", ratio=1)
        if bars:
            table.add_column(width=BAR)
        for width in NUMBERS:
            table.add_column(no_wrap=True, justify="right", min_width=width)
        height = max(1, self.console.height - 3)
        for task, run in shown[:height]:
            table.add_row(self._label(task, run), *self._row(task, progress[task, run], bars))
        lines: list[Any] = [table]
        if len(shown) > height:
            lines.append(Text(f"and {len(shown) - height} more", style="dim"))
        going = {run: progress[task, run] for task, run in shown if run}
        self.live.update(Group(*lines, self._whole(going)))

    def _label(self, task: Task, run: PlannedRun | None) -> str:
        """The label of a run, or of a task without runs."""
        return self.labels[run] if run else f"{task.kind} {task.label}"

    def _progress(self, task: Task, run: PlannedRun | None) -> Mapping[str, Any] | None:
        """The progress of a run, unless an earlier process wrote it."""
        found = read_progress(self.out / run.run_id) if run else None
        if found:
            with contextlib.suppress(KeyError, TypeError, ValueError):
                if datetime.fromisoformat(found["updated"]) >= self.begun[task][1] - SKEW:
                    return found
        return None

    def _row(self, task: Task, progress: Mapping[str, Any] | None, bars: bool) -> list[Any]:
        """The cells of a live line after its label."""
        if not task.team:
            elapsed = duration(time.monotonic() - self.begun[task][0])
            return [*([""] if bars else []), "", "", "for", elapsed]
        share = share_done(progress)
        first = [ProgressBar(total=1.0, completed=share, width=BAR)] if bars else []
        if progress is None:
            return [*first, "", "", "starting", ""]
        success = progress.get("success")
        rate, left = progress.get("steps_per_second"), progress.get("seconds_left")
        phase = progress.get("phase", "")
        return [
            *first,
            f"{steps_done(progress):,}/{progress['budget']:,}",
            "" if success is None else f"{success:.0%}",
            f"{rate:,.0f} steps/s" if phase == "training" and rate else phase,
            "" if left is None or share == 1 else duration(left),
        ]

    def _whole(self, going: Mapping[PlannedRun, Mapping[str, Any] | None]) -> Text:
        todo = [run for run in self.waiting if run not in going]
        left = self.estimate.left(todo, going, self.workers or len(going))
        words = [f"{self.counts['finished']} of {self.total} runs finished"]
        if self.counts["failed"]:
            words.append(f"{self.counts['failed']} failed")
        words.append("time left unknown" if left is None else f"about {duration(left)} left")
        return Text(", ".join(words), style="bold", no_wrap=True, overflow="ellipsis")
