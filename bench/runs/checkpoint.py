"""The checkpoint of a run: one file of tensors and plain data, and its checksum.

A checksum says that a file was copied well, not that a run wrote it: its form is checked, too.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import warnings
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from pydantic import BaseModel, ConfigDict, Field
from torch.utils._pytree import tree_leaves

from symsteer.bench.runs.folder import CHECKPOINT
from symsteer.errors import UserError, first_problem
from symsteer.files import write_atomically
from symsteer.policies.files import DAMAGE

FORMAT = 4
CHECKSUM_BYTES = 32
CURE = "delete it to start the run from the beginning"

Count = Annotated[int, Field(ge=0, le=10**12)]
Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Part = Literal["simulate", "decode", "update", "evaluate", "diagnose", "total"]


class Counters(BaseModel):
    """The numbers of a run that a checkpoint keeps."""

    model_config = ConfigDict(strict=True)

    env_steps: Count
    decisions: Count
    updates: Count
    train_until: Count | None
    next_evaluation: Count
    fresh_starts: Count
    final: bool


class _State(Counters):
    """What a run saves; agent and replay check their own parts."""

    base_policy: str
    agent: dict[str, Any]
    replay: dict[str, Any] | None
    evaluations: Count
    history: str
    recent_episodes: dict[str, list[float]]
    seconds: Annotated[dict[Part, Seconds], Field(min_length=6)]


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
        UserError: if the file is damaged, of another run, or holds no state of a run.
    """
    path = folder / CHECKPOINT
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise UserError(f"{path} cannot be read as a checkpoint; {CURE}") from error
    archive, checksum = content[:-CHECKSUM_BYTES], content[-CHECKSUM_BYTES:]
    if hashlib.sha256(archive).digest() != checksum:
        raise UserError(
            f"{path} is damaged or not a checkpoint of this version: its contents do not match its "
            f"checksum; {CURE}"
        )
    try:
        with zipfile.ZipFile(io.BytesIO(archive)) as whole:
            sizes = {member.filename: member.file_size for member in whole.infolist()}
        if sum(sizes.values()) > len(archive):
            raise ValueError("it is packed, and may be of any size")
        # Also where the run's GPU is missing.
        file = torch.load(io.BytesIO(archive), map_location="cpu", weights_only=True)
        # torch believes the sizes that are written beside its tensors, and reads beyond their ends.
        tensors = (leaf for leaf in tree_leaves(file) if isinstance(leaf, torch.Tensor))
        held = {s.data_ptr(): s.nbytes() for s in map(torch.Tensor.untyped_storage, tensors)}
        told = (size for name, size in sizes.items() if "/data/" in name)
        if sorted(filter(None, held.values())) != sorted(filter(None, told)):
            raise ValueError("a tensor has another size than its data")
    # Pickles of other programs fail in many ways.
    except Exception as error:
        raise UserError(f"{path} cannot be read as a checkpoint; {CURE}") from error
    if not isinstance(file, dict) or file.get("format") != FORMAT or "state" not in file:
        raise UserError(f"{path} is not a checkpoint that this version reads; {CURE}")
    if file.get("run_id") != folder.name:
        raise UserError(
            f"{path} is of another run ({str(file.get('run_id'))[:120]}); put it back, or {CURE}"
        )
    with fitting(path):
        _State.model_validate(file["state"])
    return file["state"]


@contextlib.contextmanager
def fitting(path: Path, cure: str = CURE) -> Iterator[None]:
    """Loading what a file of a run holds: a UserError names the file where its form is wrong."""
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    except DAMAGE as error:
        reason = " ".join(first_problem(error).split())[:300]
        raise UserError(f"{path} is damaged or does not fit its run ({reason}); {cure}") from error
