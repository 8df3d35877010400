"""The tasks that the processes of a sweep execute, on this machine or on a cluster.

They return errors as text instead of raising them, because not every exception can be sent to
another process.
"""

from __future__ import annotations

import gc
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch

from symsteer.bench.runs.base_policy import demonstration_file, find_base, prepare_base
from symsteer.bench.runs.config import RunConfig
from symsteer.bench.runs.folder import RunBusyError, is_finished, run_id
from symsteer.bench.runs.run import execute
from symsteer.errors import UserError

POLL_SECONDS = 0.5

LONGEST_REASON = 500


@dataclass(frozen=True)
class Result:
    """How a task ended."""

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


def build_demonstrations(config: RunConfig, out: Path) -> Result:
    """Collect the demonstrations of a run, if they do not exist."""
    return _guarded(lambda: demonstration_file(config, out, progress=False))


def build_base(config: RunConfig, out: Path) -> Result:
    """Train the base policy of a run, if it does not exist."""
    return _guarded(lambda: prepare_base(config, out, progress=False))


def play(config: RunConfig, out: Path, patience: float) -> Result:
    """Execute a run, or continue it.

    Args:
        config: of the run.
        out: folder of the runs.
        patience: seconds to wait until files of another machine are visible here: the base policy
            that it has trained, or the released lock of the run.
    """
    folder = out / run_id(config, {})
    deadline = time.monotonic() + patience
    while find_base(config, out) is None and time.monotonic() < deadline:
        time.sleep(POLL_SECONDS)
    while True:
        if is_finished(folder):
            return Result("done")
        try:
            return _guarded(lambda: execute(config, out, progress=False))
        except RunBusyError as error:
            if time.monotonic() > deadline:
                return Result("busy", str(error))
        time.sleep(POLL_SECONDS)


def _guarded(action: Callable[[], object]) -> Result:
    one_thread()
    try:
        action()
    except RunBusyError:
        raise
    except UserError as error:
        return Result("failed", str(error))
    except Exception as error:
        return Result("failed", f"{type(error).__name__}: {error}", traceback.format_exc())
    finally:
        # Free the simulations of a failed run: a process can hold only a few.
        gc.collect()
    return Result("done")
