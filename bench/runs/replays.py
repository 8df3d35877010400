"""The decisions of a finished run, for those who want to learn from them."""

from __future__ import annotations

from pathlib import Path

from safetensors.torch import load as deserialize
from safetensors.torch import save as serialize

from symsteer.agents.replay import Batch, ReplayBuffer
from symsteer.bench.runs.checkpoint import fitting
from symsteer.errors import UserError
from symsteer.files import write_atomically

REPLAY = "replay.safetensors"
FIELDS = ("obs", "noise", "actions", "reward", "next_obs", "terminal", "truncated")


def store_replay(replay: ReplayBuffer, folder: Path) -> None:
    """Write the decisions that a run keeps, in the order of the buffer."""
    rows = {name: replay.storage[name][: len(replay)].cpu().contiguous() for name in FIELDS}
    write_atomically(folder / REPLAY, serialize(rows))


def stored_replay(folder: Path) -> Batch:
    """The decisions of a run; see :class:`~symsteer.agents.replay.Transition`.

    Raises:
        UserError: if the run did not keep them, or the file is damaged.
    """
    path = folder / REPLAY
    if not path.is_file():
        raise UserError(
            f"the run {folder.name} did not keep its decisions; run it with --keep-replay, which "
            f"writes {REPLAY} at the end"
        )
    with fitting(path, "restore it, or repeat the run"):
        found = Batch(deserialize(path.read_bytes()))
        if missing := [name for name in FIELDS if name not in found]:
            raise ValueError(f"it lacks {', '.join(missing)}")
    return found
