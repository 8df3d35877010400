"""The checkpoint of a run: one file with tensors, plain data and their checksum."""

from __future__ import annotations

import hashlib
import io
import warnings
from pathlib import Path
from typing import Any

import torch

from symsteer.bench.runs.folder import CHECKPOINT
from symsteer.errors import UserError
from symsteer.files import write_atomically

FORMAT = 3


def save_checkpoint(folder: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint of tensors and plain data atomically.

    The state is stored as bytes with their SHA-256, because ``torch.load`` does not verify the
    checksums of the archive that it reads.
    """
    inner = io.BytesIO()
    torch.save(state, inner)
    payload = inner.getvalue()
    outer = io.BytesIO()
    torch.save(
        {
            "format": FORMAT,
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
        UserError: if the file is damaged or belongs to another run.
    """
    path = folder / CHECKPOINT
    cure = "delete it to start the run from the beginning"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch's warnings about other pickle files
            file = torch.load(io.BytesIO(path.read_bytes()), weights_only=True)
    except FileNotFoundError:
        return None
    # A damaged archive fails in many ways: zip, pickle, key and runtime errors.
    except Exception as error:
        raise UserError(f"{path} cannot be read as a checkpoint; {cure}") from error
    if not isinstance(file, dict) or file.get("format") != FORMAT:
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
