"""The folder of a run: its files, its lock and its state.

The files: config.json, record.json, policy.safetensors (the base policy that is steered),
checkpoint.pt, progress.json, the TensorBoard events, and .lock, which is locked by the process that
works on the run.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Literal

from filelock import FileLock, Timeout

from symsteer.bench.runs.config import RunConfig
from symsteer.errors import UserError
from symsteer.files import shallow, write_atomically
from symsteer.leaderboard.records import read_record, run_id_of

State = Literal["missing", "running", "interrupted", "failed", "finished"]

CONFIG, RECORD, CHECKPOINT = "config.json", "record.json", "checkpoint.pt"
PROGRESS, LOCK = "progress.json", ".lock"


class RunBusyError(UserError):
    """Another process is working on the run."""


def run_id(config: RunConfig, files: Mapping[str, str]) -> str:
    """The name of a run; ``files``: hashes of those of the user that it starts from, by kind."""
    return run_id_of({**config.to_json(), "files": files})


def is_finished(folder: Path) -> bool:
    """Whether the folder holds the record of a finished run."""
    try:
        return read_record(folder / RECORD).status == "finished"
    except UserError:
        return False


def state_of(folder: Path) -> State:
    """The state of a run.

    ``running`` means that a process holds the lock of the run. If the process was killed, the state
    is ``interrupted`` for every status in the record, and the run can be continued.
    """
    if is_finished(folder):
        return "finished"
    if not (folder / CONFIG).is_file():
        return "missing"
    if _is_held(folder):
        return "running"
    try:
        return "failed" if read_record(folder / RECORD).status == "failed" else "interrupted"
    except UserError:
        return "interrupted"


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Create the folder of a run if it is missing, and lock it against other processes.

    The operating system releases the lock when the process ends.

    Raises:
        UserError: if the run is finished already, or the folder cannot be written.
        RunBusyError: if another process is working on the run.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Try for a while: a process that reads the state of a run holds its lock for a moment.
        lock = FileLock(folder / LOCK, timeout=1)
        lock.acquire()
    except Timeout as error:
        raise RunBusyError(
            f"another process is working on the run {folder.name}; wait for it or stop it"
        ) from error
    except OSError as error:
        raise UserError(
            f"cannot write to {folder.parent}: {error.strerror}; "
            "choose a writable folder with --runs"
        ) from error
    try:
        if is_finished(folder):
            raise UserError(
                f"the run {folder.name} is finished already in {folder.parent}; "
                "choose another --runs or --seed, or delete its folder to run it again"
            )
        yield
    finally:
        lock.release()


def discard_empty(folder: Path) -> None:
    """Remove the folder of a run that has no results yet."""
    if not {path.name for path in folder.iterdir()} - {CONFIG, PROGRESS, LOCK}:
        for path in folder.iterdir():
            path.unlink()
        folder.rmdir()


def write_json(path: Path, data: Any) -> None:
    """Write indented JSON atomically; refuses NaN and infinities."""
    write_atomically(path, (json.dumps(data, indent=2, allow_nan=False) + "\n").encode())


def read_config(folder: Path) -> dict[str, Any]:
    """The resolved configuration of a run.

    Raises:
        UserError: if the folder is not the folder of a run, or its configuration is damaged.
    """
    path = folder / CONFIG
    try:
        data = shallow(json.loads(path.read_text("utf-8-sig")))
    except (FileNotFoundError, NotADirectoryError) as error:
        raise UserError(
            f"{folder} is not the folder of a run: it has no {CONFIG}; name a folder that "
            "`symsteer run` or `symsteer sweep` wrote"
        ) from error
    except (OSError, ValueError, RecursionError) as error:
        raise UserError(
            f"{path} cannot be read ({error}); restore it, or start the run again"
        ) from error
    if not isinstance(data, dict):
        raise UserError(f"{path} is not the configuration of a run; restore it")
    return data


def read_progress(folder: Path) -> dict[str, Any] | None:
    """The contents of ``progress.json``; None if it is missing or damaged."""
    try:
        data = json.loads((folder / PROGRESS).read_text("utf-8-sig"))
    except (OSError, ValueError, RecursionError):
        return None
    return data if isinstance(data, dict) and "env_steps" in data else None


def _is_held(folder: Path) -> bool:
    lock = FileLock(folder / LOCK, timeout=0)
    try:
        with lock:
            return False
    except Timeout:
        return True
    except OSError:  # no process can work in a folder that cannot be written
        return False
