"""The caller's side of the worker processes: sends requests, waits for answers, ends them."""

from __future__ import annotations

import pickle
import signal
from collections.abc import Sequence
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, NoReturn

from symsteer.bench.sim.errors import WorkerError, WorkerLostError
from symsteer.bench.sim.shards.processes import start_process
from symsteer.bench.sim.shards.worker import dumps, serve

_CLOSE_SECONDS = 5.0
"""A worker that has not ended this long after its connection was closed is killed."""


class WorkerGroup:
    """Worker processes, each of which answers one request at a time.

    Args:
        names: of the workers, for messages.
        preload: module that they need.
    """

    def __init__(self, names: Sequence[str], preload: str) -> None:
        self.lost = ""
        self.processes: list[BaseProcess] = []
        self.connections: list[Connection] = []
        try:
            for name in names:
                ours, theirs = Pipe()
                self.connections.append(ours)
                with theirs:
                    process = start_process(serve, theirs, preload=preload, name=name)
                self.processes.append(process)
        except BaseException:
            self.close()
            raise

    @property
    def pids(self) -> list[int]:
        """Process ids."""
        return [process.pid for process in self.processes if process.pid is not None]

    def ask(self, name: str, requests: Sequence[tuple | None]) -> list[Any]:
        """Send each worker the arguments of a request (None: no request); returns the answers.

        Raises:
            UserError, WorkerError: as raised in a worker. All can be asked again.
            WorkerLostError: a worker's process has ended. All others were ended too.
        """
        messages = {i: dumps((name, args)) for i, args in enumerate(requests) if args is not None}
        for i, message in messages.items():
            try:
                self.connections[i].send_bytes(message)
            except (BrokenPipeError, ConnectionResetError):
                self._lose(i)
        # Receive all answers before raising: none may be left in a pipe for the next request.
        answers = []
        for i in messages:
            try:
                answers.append(pickle.loads(self.connections[i].recv_bytes()))
            except (EOFError, ConnectionResetError):
                self._lose(i)
        errors = [answer for answer in answers if isinstance(answer, Exception)]
        if errors:
            # A bug explains more than a user's mistake, so it goes first.
            raise max(errors, key=lambda error: isinstance(error, WorkerError))
        return answers

    def _lose(self, i: int) -> NoReturn:
        """Close all workers because worker ``i`` has ended, and say how it ended."""
        process = self.processes[i]
        process.join(_CLOSE_SECONDS)
        code = process.exitcode
        if code is None or code >= 0:
            how = "closed its connection" if code is None else f"ended with exit code {code}"
        else:
            known = [s.name for s in signal.Signals if s == -code]
            how = f"was killed by {known[0] if known else f'signal {-code}'}"
            if -code == signal.SIGKILL:
                how += " (as the system does when memory runs out)"
        self.lost = f"{process.name} {how}"
        self.close()
        raise WorkerLostError(
            f"{self.lost}, and the environments with it: make the environment again"
        ) from None

    def close(self) -> None:
        """Close the connections, which ends the workers; kill those that take too long."""
        for connection in self.connections:
            connection.close()
        for process in self.processes:
            process.join(_CLOSE_SECONDS)
            if process.is_alive():
                process.kill()
                process.join()
            process.close()
        self.processes.clear()
