"""Time of computations that take turns, and of their matrix products alone."""

from __future__ import annotations

import contextlib
import os
import subprocess
import time
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch.utils._python_dispatch import TorchDispatchMode

from symsteer.errors import UserError

WARM_UP = 5
"""Calls before the first measurement."""

PRODUCTS = ("mm", "addmm", "bmm", "baddbmm", "convolution")
"""Operations that multiply matrices."""


def clock_of(devices: Sequence[str]) -> Callable[[], float]:
    """What times computations on these devices, in seconds.

    CPU time is disturbed less by other programs. A GPU does its work beside the processor, so it
    has wall-clock time, and the processor that it is compared with, too.
    """
    return time.process_time if set(devices) == {"cpu"} else _wall_clock


def time_on(devices: Sequence[str]) -> str:
    """The time that :func:`clock_of` shows, as the beginning of a sentence."""
    return "CPU time" if set(devices) == {"cpu"} else "Wall-clock time"


def _wall_clock() -> float:
    torch.cuda.synchronize()
    return time.perf_counter()


def in_turns(
    contenders: Sequence[Callable[[], Any]],
    calls: int,
    repeats: int,
    report: Callable[[str], None],
    clock: Callable[[], float] = time.process_time,
) -> list[list[float]]:
    """Milliseconds of one call, ``repeats`` measurements of each contender.

    They take turns, so that a change in the machine's speed reaches all of them.

    Args:
        contenders: what is timed.
        calls: in one measurement.
        repeats: measurements of each contender.
        report: receives a line for each round.
        clock: see :func:`clock_of`.
    """
    for run in contenders:
        _seconds(run, WARM_UP, clock)
    times: list[list[float]] = [[] for _ in contenders]
    for turn in range(repeats):
        for measured, run in zip(times, contenders, strict=True):
            measured.append(1e3 * _seconds(run, calls, clock) / calls)
        report(f"round {turn + 1} of {repeats}")
    return times


def _seconds(run: Callable[[], Any], calls: int, clock: Callable[[], float]) -> float:
    if isinstance(run, OtherProgram):
        return run.seconds(calls)
    begin = clock()
    for _ in range(calls):
        run()
    return clock() - begin


class OtherProgram:
    """A computation in a program of its own, which times itself.

    The program reads a number of calls from each line of its input, and answers with the seconds
    of CPU time that they took.

    Args:
        command: starts it.
    """

    def __init__(self, command: Sequence[str]):
        one_thread = "--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1"
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "XLA_FLAGS": one_thread}
        pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self.program = command[0]
        try:
            self.process = subprocess.Popen(command, env=environment, **pipes)
        except OSError as error:
            raise UserError(f"{command[0]} does not start ({error.strerror})") from error

    def __call__(self) -> None:
        self.seconds(1)

    def seconds(self, calls: int) -> float:
        """CPU seconds of some calls."""
        assert self.process.stdin is not None
        assert self.process.stdout is not None
        answer = ""
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.write(f"{calls}\n")
            self.process.stdin.flush()
            answer = self.process.stdout.readline()
        if not answer:
            raise UserError(f"{self.program} ended early; it may lack a package (see above)")
        return float(answer)


def products_of(run: Callable[[], Any]) -> Callable[[], None]:
    """The matrix products of a computation alone, on the same matrices."""
    seen: list[tuple[Any, list[Any]]] = []

    class Products(TorchDispatchMode):
        def __torch_dispatch__(
            self, function: Any, types: Any, args: Any = (), kwargs: Any = None
        ) -> Any:
            if function._schema.name.removeprefix("aten::") in PRODUCTS:
                seen.append(
                    (function, [a.detach() if isinstance(a, torch.Tensor) else a for a in args])
                )
            return function(*args, **(kwargs or {}))

    with Products():
        run()

    def products() -> None:
        with torch.no_grad():
            for function, args in seen:
                function(*args)

    return products
