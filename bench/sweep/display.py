"""How a sweep shows itself: live lines on a terminal, a plain line a finished run elsewhere."""

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
from symsteer.bench.sweep.estimate import Estimate, duration, share_done
from symsteer.bench.sweep.plan import Cell, Plan, short_labels
from symsteer.bench.sweep.schedule import Outcome, Task
from symsteer.bench.sweep.survey import look
from symsteer.bench.sweep.work import Result

BAR, NUMBERS = 20, (15, 4, 11, 6)
"""Columns of the bar, and of the numbers after it: steps, success, speed, time left."""

GAP = 2
"""Columns between two of a live line's parts."""

SKEW = timedelta(seconds=5)
"""By how much the clocks of two machines may differ."""


class Display(contextlib.AbstractContextManager):
    """Prints a line for each run that ends, and nothing else: for logs and pipes.

    Args:
        plan: of the sweep.
        todo: the cells that are to run.
        estimate: what is known of the time that runs take.
        workers: runs side by side; None if the cluster decides.
        console: where it prints.
    """

    def __init__(
        self,
        plan: Plan,
        todo: list[Cell],
        estimate: Estimate,
        workers: int | None,
        console: Console,
    ):
        self.out, self.estimate, self.workers = plan.out, estimate, workers
        self.console = console
        self.waiting = dict.fromkeys(todo)
        self.total = len(plan.cells)
        self.counts = Counter({"finished": self.total - len(todo)})
        self.labels = {cell: cell.label for cell in todo}

    def __exit__(self, *details: object) -> None:
        pass

    def started(self, task: Task) -> None:
        """A task was handed to a worker."""

    def retried(self, task: Task, result: Result) -> None:
        """A task did not succeed and will be tried again."""

    def ended(self, outcome: Outcome) -> None:
        """A cell is over."""
        self.waiting.pop(outcome.cell, None)
        self.counts[outcome.status] += 1
        detail = outcome.reason
        if outcome.status == "finished":
            seen = look(self.out / outcome.cell.run_id)
            self.estimate.add(outcome.cell, seen.seconds)
            detail = f"{seen.success}, {duration(seen.seconds)}"
        count = f"[{self.counts.total():{len(str(self.total))}d}/{self.total}]"
        width = max(len(label) for label in self.labels.values())
        self.write(outcome.status, f"{count} {self.labels[outcome.cell]:{width}s}  {detail}")

    def refresh(self, running: list[Task]) -> None:
        """Some time has passed."""

    def write(self, status: str, text: str) -> None:
        """One line that stays."""
        # Not by the console, which folds lines.
        # A sweep does not end because nobody reads its lines any more.
        with contextlib.suppress(BrokenPipeError):
            print(f"{status:9s} {text}", file=self.console.file, flush=True)


class LiveDisplay(Display):
    """On a terminal: below the lines that stay, a live line a run and one for the whole."""

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
        """A task was handed to a worker."""
        self.begun[task] = time.monotonic(), datetime.now(UTC)

    def retried(self, task: Task, result: Result) -> None:
        """A task did not succeed and will be tried again."""
        label = self.labels[task.cell] if task.cell else f"{task.kind} {task.label}"
        self.write("again", f"{label}: {result.reason}")

    def write(self, status: str, text: str) -> None:
        """One line that stays."""
        line = Text(f"{status:9s} ", style=self.STYLES.get(status, "yellow"))
        line.append(text, style="default")
        # Long reasons are cut here; the list at the end has them whole.
        line.truncate(self.console.width, overflow="ellipsis")
        self.console.print(line)

    def refresh(self, running: list[Task]) -> None:
        """Some time has passed."""
        said = {task: self._progress(task) for task in running}
        # A cluster holds tasks that wait for a processor: those that say nothing do nothing.
        shown = [task for task in running if self.workers or said[task]]
        bars = self.longest + BAR + GAP <= self.room
        table = Table.grid(padding=(0, GAP, 0, 0), expand=True)
        table.add_column(no_wrap=True, overflow="ellipsis", ratio=1)
        if bars:
            table.add_column(width=BAR)
        for width in NUMBERS:
            table.add_column(no_wrap=True, justify="right", min_width=width)
        height = max(1, self.console.height - 3)
        for task in shown[:height]:
            label = self.labels[task.cell] if task.cell else f"{task.kind} {task.label}"
            table.add_row(label, *self._row(task, said[task], bars))
        lines: list[Any] = [table]
        if len(shown) > height:
            lines.append(Text(f"and {len(shown) - height} more", style="dim"))
        going = {task.cell: said[task] for task in shown if task.cell}
        self.live.update(Group(*lines, self._whole(going)))

    def _progress(self, task: Task) -> Mapping[str, Any] | None:
        """What a run says of itself, unless that is left from an earlier process."""
        found = read_progress(self.out / task.cell.run_id) if task.cell else None
        if found:
            with contextlib.suppress(KeyError, TypeError, ValueError):
                if datetime.fromisoformat(found["updated"]) >= self.begun[task][1] - SKEW:
                    return found
        return None

    def _row(self, task: Task, progress: Mapping[str, Any] | None, bars: bool) -> list[Any]:
        """What follows the label of a live line."""
        if not task.cell:
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
            f"{progress['env_steps']:,}/{progress['budget']:,}",
            "" if success is None else f"{success:.0%}",
            f"{rate:,.0f} steps/s" if phase == "training" and rate else phase,
            "" if left is None or share == 1 else duration(left),
        ]

    def _whole(self, going: Mapping[Cell, Mapping[str, Any] | None]) -> Text:
        todo = [cell for cell in self.waiting if cell not in going]
        left = self.estimate.left(todo, going, self.workers or len(going))
        words = [f"{self.counts['finished']} of {self.total} runs finished"]
        if self.counts["failed"]:
            words.append(f"{self.counts['failed']} failed")
        words.append("time left unknown" if left is None else f"about {duration(left)} left")
        return Text(", ".join(words), style="bold", no_wrap=True, overflow="ellipsis")
