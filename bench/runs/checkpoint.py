"""The checkpoint of a run: one file of tensors and plain data."""

from __future__ import annotations

import io
import warnings
import zipfile
from pathlib import Path
from typing import Any

import torch

from symsteer.bench.runs.folder import CHECKPOINT
from symsteer.errors import UserError
from symsteer.files import write_atomically

FORMAT = 3


def save_checkpoint(folder: Path, state: dict[str, Any]) -> None:
    """Write a checkpoint of tensors and plain data atomically: the old one stays until then."""
    buffer = io.BytesIO()
    torch.save({"format": FORMAT, "run_id": folder.name, "state": state}, buffer)
    write_atomically(folder / CHECKPOINT, buffer.getvalue())


def load_checkpoint(folder: Path) -> dict[str, Any] | None:
    """The last checkpoint of a run (``weights_only``), or None before the first one.

    Raises:
        UserError: if the file is damaged or belongs to another run.
    """
    path = folder / CHECKPOINT
    cure = "delete it to start the run from the beginning"
    try:
        content = io.BytesIO(path.read_bytes())
    except FileNotFoundError:
        return None
    try:
        # torch.load does not verify the checksums of the archive that it reads.
        with zipfile.ZipFile(content) as archive:
            damaged = archive.testzip()
        content.seek(0)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch warns about pickles that it did not write
            file = torch.load(content, weights_only=True)
    # A damaged archive fails in many ways: zip, pickle, key and runtime errors.
    except Exception as error:
        raise UserError(f"{path} cannot be read as a checkpoint; {cure}") from error
    if damaged:
        raise UserError(f"{path} is damaged: its contents do not match its checksum; {cure}")
    if not isinstance(file, dict) or file.get("format") != FORMAT or "state" not in file:
        raise UserError(f"{path} is not a checkpoint that this version reads; {cure}")
    if file.get("run_id") != folder.name:
        raise UserError(
            f"{path} is of another run ({str(file.get('run_id'))[:120]}); put it back, or {cure}"
        )
    return file["state"]
