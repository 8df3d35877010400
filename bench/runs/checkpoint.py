"""The checkpoint of a run: one file of tensors and plain data, and its checksum."""

from __future__ import annotations

import hashlib
import io
from pathlib import Path
from typing import Any

import torch

from symsteer.bench.runs.folder import CHECKPOINT
from symsteer.errors import UserError
from symsteer.files import write_atomically

FORMAT = 4
CHECKSUM_BYTES = 32


def save_checkpoint(folder: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint of tensors and plain data atomically.

    The SHA-256 of the archive follows it, because ``torch.load`` does not verify the checksums of
    the archive that it reads.
    """
    buffer = io.BytesIO()
    torch.save({"format": FORMAT, "run_id": folder.name, "state": state}, buffer)
    archive = buffer.getvalue()
    write_atomically(folder / CHECKPOINT, archive + hashlib.sha256(archive).digest())


def load_checkpoint(folder: Path) -> dict[str, Any] | None:
    """The last checkpoint of a run on the CPU (``weights_only``), or None before the first one.

    Raises:
        UserError: if the file is damaged or of another run.
    """
    path = folder / CHECKPOINT
    cure = "delete it to start the run from the beginning"
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise UserError(f"{path} cannot be read as a checkpoint; {cure}") from error
    archive, checksum = content[:-CHECKSUM_BYTES], content[-CHECKSUM_BYTES:]
    if hashlib.sha256(archive).digest() != checksum:
        raise UserError(
            f"{path} is damaged or not a checkpoint of this version: its contents do not match its "
            f"checksum; {cure}"
        )
    try:
        # Also where the run's GPU is missing.
        file = torch.load(io.BytesIO(archive), map_location="cpu", weights_only=True)
    # Pickles of other programs fail in many ways.
    except Exception as error:
        raise UserError(f"{path} cannot be read as a checkpoint; {cure}") from error
    if not isinstance(file, dict) or file.get("format") != FORMAT or "state" not in file:
        raise UserError(f"{path} is not a checkpoint that this version reads; {cure}")
    if file.get("run_id") != folder.name:
        raise UserError(
            f"{path} is of another run ({str(file.get('run_id'))[:120]}); put it back, or {cure}"
        )
    return file["state"]
