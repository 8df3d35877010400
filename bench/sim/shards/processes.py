"""Starting worker processes.

Importing ManiSkill takes seconds, which every spawned process would pay. Forking the caller's own
process is not safe, because torch may have started threads in it. So workers are forked from
Python's fork server: a fresh interpreter with one thread that imports ManiSkill once. It starts
with the first worker and ends with the caller's process.

`multiprocessing` has one fork server in a process. If the caller has started it before, for
something else, each worker imports ManiSkill itself: slower, with the same results.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from multiprocessing import forkserver, resource_tracker
from multiprocessing.context import ForkServerProcess
from typing import Any

_WORKER = "symsteer.bench.sim.shards.worker"

_SETTINGS = dict.fromkeys(
    ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "PYTHONSAFEPATH"), "1"
)

_CONTEXT = multiprocessing.get_context("forkserver")


def start_process(
    target: Callable[..., None], *args: Any, preload: str = _WORKER, name: str | None = None
) -> ForkServerProcess:
    """Start a daemon process that calls ``target(*args)``.

    It uses one thread and does not react to Ctrl-C, which a terminal sends to all processes: the
    caller's process decides what to do. The caller's main module is not imported, so scripts need
    no ``if __name__ == "__main__"`` guard.

    Args:
        target: top-level function of a module other than the main one.
        args: its arguments.
        preload: module that the fork server imports, if it is not running yet.
        name: of the process.
    """
    _CONTEXT.set_forkserver_preload([_WORKER, preload])
    with _worker_settings():
        forkserver.ensure_running()
    process = _CONTEXT.Process(target=target, args=args, name=name, daemon=True)
    with _without_main_module():
        process.start()
    return process


@contextmanager
def signals_wait(*numbers: int) -> Iterator[None]:
    """Signals wait while processes are started, and never reach these: they inherit the mask."""
    resource_tracker.ensure_running()  # its start would unblock signals
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)


@contextmanager
def _worker_settings() -> Iterator[None]:
    """What the fork server inherits: one thread, no import from here, SIGINT blocked."""
    before = dict(os.environ)
    os.environ.update(_SETTINGS)
    try:
        with signals_wait(signal.SIGINT):
            yield
    finally:
        for name in _SETTINGS.keys() - before.keys():
            del os.environ[name]
        os.environ.update(before)


@contextmanager
def _without_main_module() -> Iterator[None]:
    """Make `multiprocessing` treat the main module as it does an interactive session's.

    A new process imports the main module again if that has a spec or a file.
    """
    main = vars(sys.modules["__main__"])
    hidden: dict[str, Any] = {name: main[name] for name in ("__spec__", "__file__") if name in main}
    main.update(dict.fromkeys(hidden))
    try:
        yield
    finally:
        main.update(hidden)
