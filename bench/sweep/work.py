"""The tasks that the processes of a sweep execute, on this machine or on a cluster.

They return errors as text instead of raising them, because not every exception can be sent to
another process.
"""

from __future__ import annotations

import gc
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import torch

from symsteer.bench.runs.base_policy import demonstration_file, find_base, prepare_base
from symsteer.bench.runs.config import Execution, RunConfig
from symsteer.bench.runs.folder import RunBusyError, is_finished, run_id
from symsteer.bench.runs.run import execute
from symsteer.bench.runs.together import execute_together
from symsteer.errors import UserError

POLL_SECONDS = 0.5

LONGEST_REASON = 500

Kind = Literal["demonstrations", "base policy", "run"]
"""What a task does."""


@dataclass(frozen=True)
class Result:
    """How a task ended, or one of the runs that it executed."""

    status: Literal["done", "failed", "busy", "lost"]
    """``busy``: another process works on the run. ``lost``: the machine was lost; this is no
    error of the task."""
    reason: str = ""
    trace: str = ""
    """The traceback of an unexpected error."""

    def __post_init__(self) -> None:
        # The message of any library becomes one line of limited length.
        line = "".join(c if c.isprintable() else "?" for c in " ".join(self.reason.split()))
        object.__setattr__(self, "reason", line[:LONGEST_REASON])


def one_thread() -> None:
    """Limit torch to one thread, because several processes share the cores."""
    torch.set_num_threads(1)


def work(kind: Kind, configs: Sequence[RunConfig], how: Execution, patience: float) -> list[Result]:
    """Execute one task; unlike the others, the task ``run`` has a result for each configuration.

    Args:
        kind: collect the demonstrations, or train the base policy, that runs share, unless they
            exist; or execute runs, or continue them: several are trained together.
        configs: of the runs.
        how: they are executed.
        patience: seconds to wait until files of another machine are visible here: the base policies
            that it has trained, or the released lock of a run.
    """
    if kind == "demonstrations":
        return [_guarded(lambda: demonstration_file(configs[0], how.runs, quiet=True))]
    if kind == "base policy":
        return [_guarded(lambda: prepare_base(configs[0], how))]
    deadline = time.monotonic() + patience
    while any(find_base(c, how.runs) is None for c in configs) and time.monotonic() < deadline:
        time.sleep(POLL_SECONDS)
    if len(configs) == 1:
        return [_play(configs[0], how, deadline)]
    one_thread()
    errors = execute_together(configs, how)
    results = [
        _play(config, how, deadline) if isinstance(error, RunBusyError) else _result(error)
        for config, error in zip(configs, errors, strict=True)
    ]
    gc.collect()
    return results


def _play(config: RunConfig, how: Execution, deadline: float) -> Result:
    folder = how.runs / run_id(config, {})
    while not is_finished(folder):
        try:
            return _guarded(lambda: execute(config, how))
        except RunBusyError as error:
            if time.monotonic() > deadline:
                return Result("busy", str(error))
        time.sleep(POLL_SECONDS)
    return Result("done")


def _guarded(action: Callable[[], object]) -> Result:
    one_thread()
    try:
        action()
    except RunBusyError:
        raise
    except Exception as error:
        return _result(error)
    finally:
        # Free the simulations of a failed run: a process can hold only a few.
        gc.collect()
    return Result("done")


def _result(error: Exception | None) -> Result:
    if error is None:
        return Result("done")
    if isinstance(error, UserError):
        return Result("failed", str(error))
    trace = "".join(traceback.format_exception(error))
    return Result("failed", f"{type(error).__name__}: {error}", trace)
