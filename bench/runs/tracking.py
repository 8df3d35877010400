"""Weights & Biases as a view of runs (``--track``).

Tracking is not part of a run's configuration, and the record is the same with and without it. What
can be known at the start is checked there; later errors end the tracking, never the run.
"""

from __future__ import annotations

import contextlib
import json
import os
import secrets
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from symsteer.errors import UserError
from symsteer.extras import extra
from symsteer.files import away, write_atomically
from symsteer.leaderboard.records import RunRecord
from symsteer.terminal import tell

PROJECT = "symsteer"
"""The project of W&B, if WANDB_PROJECT names no other."""

STATE = "wandb.json"
"""Id, group and last step of a tracked run, in its folder."""

LONGEST_REASON = 200
"""Characters that are shown of an error of W&B."""

FINISH_SECONDS = 60.0
"""How long the end of a run waits until W&B has everything; the rest can be uploaded later."""


def check_tracking(wanted: bool) -> None:
    """Check that ``--track`` can work, if it is wanted.

    Raises:
        UserError: if W&B is not installed, or nobody is logged in and it is not offline.
    """
    if not wanted:
        return
    with extra("wandb", "--track"):
        # A folder wandb, as W&B makes them, can be imported, too, but it is empty.
        from wandb import login, setup
    try:
        with away():  # W&B takes settings, such as the host that gets the key, from ./wandb
            mode = setup().settings.mode
        ready = mode in ("offline", "dryrun", "disabled") or login(prompt=False)
        reason = "no API key was found"
    except Exception as error:
        ready, reason = False, _one_line(error)
    if not ready:
        raise UserError(
            f"--track cannot log in to Weights & Biases ({reason}); run `wandb login`, set "
            "WANDB_MODE=offline to upload later, or leave --track out"
        )


class WandbLog:
    """W&B's view of one run: the scalars and pictures of TensorBoard, and the configuration.

    Args:
        folder: of the run; W&B's files are in the folder ``wandb`` there.
        record: the run's record at its start.
        group: name of what the run belongs to; a run that goes on keeps its own.
    """

    def __init__(self, folder: Path, record: RunRecord, group: str | None):
        self._path = folder / STATE
        state = _read(self._path)
        self._state = {"id": secrets.token_hex(4), "group": group, "step": -1, **state}
        # What W&B has already; a continued run repeats steps after its checkpoint.
        self._first = self._state["step"] + 1
        self._run: Any = None
        with self._tolerant():
            self._write()
        folder = folder.resolve()
        with self._tolerant(), away():
            import wandb

            self._run = wandb.init(
                id=self._state["id"],
                name=record.run_id,
                group=self._state["group"],
                job_type=record.role,
                project=os.environ.get("WANDB_PROJECT", PROJECT),
                dir=folder,
                config={**record.config, "commit": record.provenance.commit},
                resume="allow",
                reinit="create_new",  # runs that are trained together share a process
                settings=wandb.Settings(
                    console="off", silent=True, finish_timeout=FINISH_SECONDS, disable_git=True
                ),
            )
            offline = f"`wandb sync {Path(self._run.dir).parent}` uploads it"
            place = offline if self._run.offline else self._run.url
            tell(f"{record.run_id} in Weights & Biases: {place or 'disabled'}")

    def scalars(self, values: Mapping[str, float | None], step: int) -> None:
        """Log all values that are not None, by tag."""
        self._log({tag: value for tag, value in values.items() if value is not None}, step)

    def level(self, values: Mapping[str, float | None], budget: int) -> None:
        """Log values that hold for the whole run."""
        # One point: W&B's steps cannot go back, and it has no lines across a chart.
        self.scalars(values, 0)

    def picture(self, tag: str, picture: np.ndarray, step: int) -> None:
        """Log a picture ``[height, width, 3]`` uint8."""
        with self._tolerant():
            if self._run is not None:
                from wandb import Image

                self._log({tag: Image(picture)}, max(step, self._state["step"]))

    def flush(self) -> None:
        """Nothing to do: another process writes what was logged."""

    def end(self, finished: bool) -> None:
        """Say that the run has ended, and whether it has finished."""
        with self._tolerant():
            if self._run is not None:
                self._run.finish(exit_code=0 if finished else 1)

    def _log(self, values: Mapping[str, Any], step: int) -> None:
        if self._run is None or step < self._first or not values:
            return
        with self._tolerant():
            self._run.log(values, step=step)
            if step > self._state["step"]:
                self._state["step"] = step
                self._write()

    def _write(self) -> None:
        write_atomically(self._path, json.dumps(self._state).encode(), durable=False)

    @contextlib.contextmanager
    def _tolerant(self) -> Iterator[None]:
        try:
            yield
        except Exception as error:
            self._run = None
            tell(f"{self._path.parent.name} goes on without Weights & Biases: {_one_line(error)}")


def _read(path: Path) -> dict[str, Any]:
    """The state of a run that was tracked before; nothing if there is none that can be read."""
    try:
        state = json.loads(path.read_text("utf-8-sig"))
        return {"id": str(state["id"]), "group": state["group"], "step": int(state["step"])}
    except (OSError, ValueError, KeyError, TypeError, RecursionError):
        return {}


def _one_line(error: BaseException) -> str:
    return " ".join(str(error).split())[:LONGEST_REASON] or type(error).__name__
