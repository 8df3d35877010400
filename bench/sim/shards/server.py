"""How worker processes are started: forked from a helper that has imported ManiSkill once.

Importing ManiSkill costs seconds, which every spawned process would pay. Forking the user's own
process is not safe, because torch may have started threads in it. So the first worker starts a
fork server (Python's own): a fresh interpreter that imports what a worker needs, with one thread,
and forks from then on; it ends with the user's process.

Unlike `multiprocessing`'s, workers do not run the user's main module again, so scripts need no
``if __name__ == "__main__"`` guard.
"""

from __future__ import annotations

import io
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import context, forkserver, popen_forkserver, reduction, spawn, util
from multiprocessing.context import set_spawning_popen
from typing import Any

ONE_THREAD = dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")


@contextmanager
def _inherited_settings() -> Iterator[None]:
    """What a process started meanwhile inherits: one thread, and deafness to Ctrl-C.

    An interrupt goes to every process of a terminal; the user's process decides what follows.
    """
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(ONE_THREAD)
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


class _Server(forkserver.ForkServer):
    def __init__(self) -> None:
        super().__init__()
        self.modules = ["symsteer.bench.sim.shards.worker"]
        self.set_forkserver_preload(self.modules)

    def ensure_running(self) -> None:
        with _inherited_settings():
            super().ensure_running()


_SERVER = _Server()


class _Popen(popen_forkserver.Popen):
    """Python's own, from our server and without the main module."""

    def _launch(self, process_obj: Any) -> None:
        preparation = {
            key: value
            for key, value in spawn.get_preparation_data(process_obj._name).items()
            if not key.startswith("init_main_from")
        }
        message = io.BytesIO()
        set_spawning_popen(self)
        try:
            reduction.dump(preparation, message)
            reduction.dump(process_obj, message)
        finally:
            set_spawning_popen(None)
        self.sentinel, writer = _SERVER.connect_to_new_process(self._fds)  # type: ignore[attr-defined]
        # The worker watches this end to notice that its parent has gone.
        parent = os.dup(writer)
        ends = (parent, self.sentinel)
        self.finalizer = util.Finalize(self, util.close_fds, ends)  # type: ignore[attr-defined]
        with open(writer, "wb", closefd=True) as file:
            file.write(message.getbuffer())
        self.pid = forkserver.read_signed(self.sentinel)


class WorkerProcess(context.ForkServerProcess):
    """A process forked from the server; takes the arguments of `multiprocessing.Process`."""

    @staticmethod
    def preload(module: str) -> None:
        """Let the server import this too, if it is not running yet."""
        if module not in _SERVER.modules:
            _SERVER.modules.append(module)

    @staticmethod
    def _Popen(process_obj: Any) -> _Popen:  # noqa: N802 (the name is Python's)
        return _Popen(process_obj)
