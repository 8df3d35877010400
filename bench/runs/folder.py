"""The folder of a run: config.json, record.json, checkpoint.pt, TensorBoard events."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import torch

from bench.runs.config import RunConfig, content_key
from leaderboard.errors import RecordError
from leaderboard.records import read_record, write_atomically
from policies.errors import UserError


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
        return read_record(folder / "record.json").status == "finished"
    except (RecordError, FileNotFoundError):
        return False


def open_run_folder(folder: Path) -> None:
    """Create the folder of a new run; what an unfinished run left there is moved aside.

    Raises:
        UserError: if the run is finished already, or the folder cannot be written.
    """
    if is_finished(folder):
        raise UserError(
            f"the run {folder.name} is finished already in {folder.parent}; "
            "choose another --out or --seed, or delete its folder to run it again"
        )
    try:
        if folder.exists():
            number = 1
            while (aside := folder.with_name(f"{folder.name}.unfinished-{number}")).exists():
                number += 1
            folder.rename(aside)
        folder.mkdir(parents=True)
    except OSError as error:
        raise UserError(
            f"cannot write to {folder.parent}: {error.strerror}; "
            "choose a writable folder with --out"
        ) from error


def write_json(path: Path, data: Any) -> None:
    """Write indented JSON atomically; refuses NaN and infinities."""
    write_atomically(path, (json.dumps(data, indent=2, allow_nan=False) + "\n").encode())


def save_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint of tensors and plain data atomically (loads with weights_only)."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    write_atomically(path, buffer.getvalue())
