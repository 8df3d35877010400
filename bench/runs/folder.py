"""The folder of a run: what lies in it, who works on it, how far it is.

config.json, record.json, policy.safetensors (the base policy that is steered), checkpoint.pt,
progress.json, the TensorBoard events, and .lock, held by the process that works on the run.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
import time
import warnings
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import torch
from filelock import FileLock, Timeout

from symsteer.bench.runs.config import RunConfig, content_key
from symsteer.errors import UserError
from symsteer.files import write_atomically
from symsteer.leaderboard.records import read_record

State = Literal["missing", "running", "interrupted", "failed", "finished"]

CONFIG, RECORD, CHECKPOINT = "config.json", "record.json", "checkpoint.pt"
PROGRESS, LOCK = "progress.json", ".lock"

CHECKPOINT_FORMAT = 2

HEARTBEAT_SECONDS = 2.0


class RunBusyError(UserError):
    """Another process is working on the run."""


def run_id(config: RunConfig, origin: dict[str, Any]) -> str:
    """A readable name that is unique to the configuration.

    Args:
        config: the run's configuration.
        origin: content hashes of demonstrations or a policy that came from files.
    """
    variant = config.variant.replace(":", "=")
    key = content_key(config.to_json(), origin)
    return f"{config.task}-{config.embodiment}-{variant}-{config.agent}-s{config.seed}-{key}"


def is_finished(folder: Path) -> bool:
    """Whether the folder holds the record of a finished run."""
    try:
        return read_record(folder / RECORD).status == "finished"
    except UserError:
        return False


def state_of(folder: Path) -> State:
    """What has become of a run.

    ``running`` means that a process holds the run now. One that was killed leaves a record which
    still says so; without the process the run is ``interrupted``, and can be continued.
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
    """Create the folder of a run if need be, and keep other processes off it.

    The lock goes with the process, however that ends.

    Raises:
        UserError: if the run is finished already, or the folder cannot be written.
        RunBusyError: if another process is working on the run.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Not at once: whoever asks for the state of a run holds its lock for a moment.
        lock = FileLock(folder / LOCK, timeout=1)
        lock.acquire()
    except Timeout as error:
        raise RunBusyError(
            f"another process is working on the run {folder.name}; wait for it or stop it"
        ) from error
    except OSError as error:
        raise UserError(
            f"cannot write to {folder.parent}: {error.strerror}; "
            "choose a writable folder with --out"
        ) from error
    try:
        if is_finished(folder):
            raise UserError(
                f"the run {folder.name} is finished already in {folder.parent}; "
                "choose another --out or --seed, or delete its folder to run it again"
            )
        yield
    finally:
        lock.release()


def discard_empty(folder: Path) -> None:
    """Remove the folder of a run that has produced nothing yet."""
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
        UserError: if the folder is no run's, or its configuration is damaged.
    """
    path = folder / CONFIG
    try:
        data = json.loads(path.read_text())
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


def save_checkpoint(folder: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint of tensors and plain data atomically: the old one stays until then.

    The state lies inside as bytes beside their SHA-256, because ``torch.load`` does not look at
    the checksums of the archive that it reads.
    """
    inner = io.BytesIO()
    torch.save(state, inner)
    payload = inner.getvalue()
    outer = io.BytesIO()
    torch.save(
        {
            "format": CHECKPOINT_FORMAT,
            "run_id": folder.name,
            "sha256": hashlib.sha256(payload).hexdigest(),
            "state": torch.frombuffer(bytearray(payload), dtype=torch.uint8),
        },
        outer,
    )
    write_atomically(folder / CHECKPOINT, outer.getvalue())


def load_checkpoint(folder: Path) -> dict[str, Any] | None:
    """The last checkpoint of a run (``weights_only``), or None before the first one.

    Raises:
        UserError: if the file is damaged or of another run.
    """
    path = folder / CHECKPOINT
    cure = "delete it to start the run from the beginning"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # what torch thinks of a foreign pickle
            file = torch.load(io.BytesIO(path.read_bytes()), weights_only=True)
    except FileNotFoundError:
        return None
    # A damaged archive fails in many ways: zip, pickle, key and runtime errors.
    except Exception as error:
        raise UserError(f"{path} cannot be read as a checkpoint; {cure}") from error
    if not isinstance(file, dict) or file.get("format") != CHECKPOINT_FORMAT:
        raise UserError(f"{path} is not a checkpoint that this version reads; {cure}")
    if file.get("run_id") != folder.name:
        raise UserError(
            f"{path} is of another run ({str(file.get('run_id'))[:120]}); put it back, or {cure}"
        )
    try:
        payload = file["state"].numpy().tobytes()
        intact = hashlib.sha256(payload).hexdigest() == file["sha256"]
    except (KeyError, AttributeError, TypeError, RuntimeError):
        intact = False
    if not intact:
        raise UserError(f"{path} is damaged: its contents do not match its checksum; {cure}")
    return torch.load(io.BytesIO(payload), weights_only=True)


class Heartbeat:
    """progress.json: how far a running run is, for `symsteer status` and the sweep's display.

    Args:
        folder: of the run.
        budget: control steps that the run may use.
        env_steps: control steps that it has used already, if it continues.
    """

    def __init__(self, folder: Path, budget: int, env_steps: int = 0):
        self._path, self._budget, self._first = folder / PROGRESS, budget, env_steps
        self._start = time.monotonic()
        self._last = -float("inf")
        self._phase = ""

    def beat(self, phase: str, env_steps: int, success: float | None = None) -> None:
        """Write now and then; a change of phase is written at once."""
        now = time.monotonic()
        if phase == self._phase and now - self._last < HEARTBEAT_SECONDS:
            return
        self._last, self._phase = now, phase
        rate = (env_steps - self._first) / max(now - self._start, 1e-9)
        data = {
            "phase": phase,
            "env_steps": env_steps,
            "budget": self._budget,
            "success": success,
            "steps_per_second": rate,
            "seconds_left": max(0, self._budget - env_steps) / rate if rate > 0 else None,
            "updated": datetime.now(UTC).isoformat(timespec="seconds"),
        }
        temporary = self._path.with_name(f".{self._path.name}.tmp")
        try:
            temporary.write_text(json.dumps(data))
            os.replace(temporary, self._path)
        except OSError:
            # A display is not worth a run: a full disk is reported where results are written.
            with contextlib.suppress(OSError):
                temporary.unlink()


def read_progress(folder: Path) -> dict[str, Any] | None:
    """What :class:`Heartbeat` wrote last; None if there is nothing legible."""
    try:
        data = json.loads((folder / PROGRESS).read_text())
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
    except OSError:  # a folder that cannot be written is nobody's
        return False
