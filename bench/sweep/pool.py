"""A pool of processes on this machine, one thread each. A process that dies is replaced."""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator, Sequence
from concurrent.futures import Future
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import Protocol

from pebble import ProcessExpired, ProcessPool
from tqdm import tqdm

from symsteer.bench.runs.config import Execution, RunConfig
from symsteer.bench.sim.shards.processes import signals_wait
from symsteer.bench.sweep.work import Kind, Result, one_thread, work
from symsteer.files import open_log

THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")


SHARED_PATIENCE = 120.0
"""A file server can need so long to release the lock of a lost machine."""


class Workers(Protocol):
    """Executes tasks."""

    capacity: int | None
    """Number of tasks at the same time; None if it decides itself."""
    patience: float
    """Seconds to wait for a run that another process seems to hold."""

    def submit(self, kind: Kind, configs: Sequence[RunConfig], how: Execution) -> Future:
        """Start a task; fewer than ``capacity`` may be running."""

    def result(self, future: Future) -> list[Result]:
        """The results of a task that has ended: one if its process died."""

    def stop(self) -> None:
        """End all processes at once."""


class LocalPool:
    """Processes that execute many tasks each, because their imports take seconds.

    Each process is a pool of its own: a pool of several processes breaks as a whole when one of
    them dies during its imports.

    Args:
        workers: number of processes; each is started when it is first needed.
        log: file that receives their output.
    """

    patience = 10.0

    def __init__(self, workers: int, log: Path):
        self.capacity: int | None = workers
        # Processes read these before they import anything.
        os.environ.update(dict.fromkeys((*THREADS, "PYTHONSAFEPATH"), "1"))
        self._log = log
        self._idle: list[ProcessPool] = [self._start() for _ in range(workers)]
        self._busy: dict[Future, ProcessPool] = {}

    def submit(self, kind: Kind, configs: Sequence[RunConfig], how: Execution) -> Future:
        pool = self._idle.pop()
        # Ctrl-C is for the sweep, which ends its processes itself. A process that is ended while it
        # starts complains, but not on the terminal.
        with signals_wait(signal.SIGINT, signal.SIGTERM), self._complaints_in_log():
            future = pool.schedule(work, (kind, configs, how, self.patience))
            self._busy[future] = pool
        return future

    @contextlib.contextmanager
    def _complaints_in_log(self) -> Iterator[None]:
        terminal = os.dup(2)
        try:
            with open_log(self._log) as file:
                os.dup2(file.fileno(), 2)
            yield
        finally:
            os.dup2(terminal, 2)
            os.close(terminal)

    def result(self, future: Future) -> list[Result]:
        pool = self._busy.pop(future)
        try:
            results = future.result()
        except (ProcessExpired, BrokenProcessPool) as error:
            pool.stop()
            pool.join()
            pool = self._start()
            results = [Result("failed", _death(getattr(error, "exitcode", None)))]
        self._idle.append(pool)
        return results

    def stop(self) -> None:
        pools = [*self._busy.values(), *self._idle]
        for pool in pools:
            pool.stop()
        for pool in pools:
            pool.join()

    def _start(self) -> ProcessPool:
        # Spawned: a fork of a process that has used torch's threads can deadlock.
        return ProcessPool(
            max_workers=1,
            initializer=_begin,
            initargs=(str(self._log),),
            context=multiprocessing.get_context("spawn"),
        )


def _begin(log: str) -> None:
    """Prepare a new process."""
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGTERM})
    one_thread()
    # Warnings of libraries and the output of a crash must not damage the display.
    with open_log(log) as file:
        for stream in (1, 2):
            os.dup2(file.fileno(), stream)
    # tqdm's default lock is a system semaphore. A killed process would not remove it.
    tqdm.set_lock(threading.RLock())
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """End this process when the sweep ends, also if the sweep is killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _death(code: int | None) -> str:
    """The meaning of a process's exit code, as text."""
    if code is None:
        return "its process ended before it started to work"
    if code >= 0:
        return f"its process ended with exit code {code}"
    name = signal.Signals(-code).name
    why = "; the system does this when memory runs out" if -code == signal.SIGKILL else ""
    return f"its process was killed by {name}{why}"
