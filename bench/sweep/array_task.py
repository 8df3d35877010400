"""A task of a Slurm array. It is light to import, because its process stays beside the sweep."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from dataclasses import dataclass
from pathlib import Path

AGAIN = os.EX_TEMPFAIL
"""Exit code of a task that is to be queued again."""


@dataclass(frozen=True)
class ArrayTask:
    """Executes a sweep as a process of its own, which Slurm's warning reaches through this one.

    Attributes:
        words: of the sweep's command line.
        checkpoints: of its runs.
        base: the folder of demonstrations and base policies.
    """

    words: tuple[str, ...]
    checkpoints: tuple[Path, ...]
    base: Path

    def __call__(self) -> None:
        """Ends the process with the exit code of the sweep, or with :data:`AGAIN`."""
        warned = threading.Event()
        signal.signal(signal.SIGUSR2, lambda number, frame: warned.set())
        saved = self._saved()
        # Slurm signals every process of the task; the sweep inherits that it does not hear this.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGUSR2})
        sweep = subprocess.Popen([sys.executable, "-m", "symsteer", *self.words])
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGUSR2})
        told = False
        while (code := _ended(sweep)) is None:
            if warned.is_set() and not told:
                sweep.terminate()  # once: it may take some time to save
                told = True
        # Slurm itself terminates the sweep of a task that is pre-empted, and does not queue that
        # again unless it is asked; it ends the batch script of one that is cancelled.
        if code == 128 + signal.SIGTERM:
            if warned.is_set() and self._saved() == saved:
                sys.exit("the task has saved nothing in its time; give it more `time`")
            code = AGAIN
        sys.exit(code)

    def _saved(self) -> set[tuple[Path, int]]:
        """What a task that was stopped continues with: files and their times."""
        kept = [*filter(Path.is_file, self.checkpoints), *self.base.glob("[!.]*")]
        return {(path, path.stat().st_mtime_ns) for path in kept}


def _ended(process: subprocess.Popen[bytes]) -> int | None:
    """The exit code, within a second; None if the process goes on."""
    try:
        return process.wait(1)
    except subprocess.TimeoutExpired:
        return None
