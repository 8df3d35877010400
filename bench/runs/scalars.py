"""The scalars of a run for those who watch it: in TensorBoard, and in W&B where it is tracked.

They are the record's numbers, and numbers of training between evaluations. Nothing reads them back.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import torch

from symsteer.bench.runs.tensorboard import RunLog
from symsteer.bench.runs.tracking import Tracking, WandbLog
from symsteer.bench.runs.trainer import Observer, Trainer
from symsteer.leaderboard.records import Evaluation, RunRecord

if TYPE_CHECKING:
    from symsteer.bench.runs.observers import RecordWriter

POINTS = 100
"""Points of a training scalar in a whole run, about."""

RECENT = 100
"""Training episodes in a running mean."""

DETAILS = re.compile(r"(q_off_|return_off_).*|.*_(std|decisions)|q_(low|high|allowance)")
"""Diagnostics that only the record has: with them, TensorBoard would have twice as many charts."""

SMALLEST_ERROR = 1e-8
"""Smaller errors are rounding; this number stands for them in logarithms."""


class Log(Protocol):
    """A view of one run; steps are control steps."""

    def scalars(self, values: Mapping[str, float | None], step: int) -> None:
        """Write all values that are not None, by tag."""

    def level(self, values: Mapping[str, float | None], budget: int) -> None:
        """Show values that hold for the whole run."""

    def picture(self, tag: str, picture: np.ndarray, step: int) -> None:
        """Write a picture ``[height, width, 3]`` uint8."""

    def film(self, tag: str, frames: Sequence[np.ndarray], rate: float, step: int) -> None:
        """Write pictures of one size, ``rate`` of them per second."""

    def flush(self) -> None:
        """Write everything to disk."""

    def finish(self) -> None:
        """The run has finished."""

    def close(self) -> None:
        """The run did not finish."""


class Scalars(Observer):
    """Writes what the record holds, and scalars of training between evaluations.

    Args:
        records: the observer that writes the record.
        tracking: a service that shows the run, too.
    """

    def __init__(self, records: RecordWriter, tracking: Tracking | None):
        self.records, self.tracking = records, tracking
        self.logs: list[Log] = []
        self.means = Means()

    def began(self, run: Trainer, checkpoint: Mapping[str, Any] | None) -> None:
        record = self.records.record
        # Even without a checkpoint, an earlier process may have written events.
        self.logs.append(RunLog(run.folder, record, run.env_steps + 1 if checkpoint else 0))
        if self.tracking is not None:
            self.logs.append(WandbLog(run.folder, record, self.tracking))
        for log in self.logs:
            log.level(reference_lines(record), run.config.env_steps)
        self.recent = RecentMeans((checkpoint or {}).get("recent_episodes", {}))
        self.written = run.env_steps

    def stepped(self, run: Trainer, scalars: Sequence[Mapping[str, torch.Tensor]]) -> None:
        episodes, *updates = scalars
        self.recent.add(episodes)
        for values in updates:
            self.means.add(values)
        if run.env_steps - self.written >= run.config.env_steps / POINTS:
            self._write_training(run)

    def paused(self, run: Trainer) -> None:
        if run.env_steps > self.written:
            self._write_training(run)

    def evaluated(self, run: Trainer, evaluation: Evaluation) -> None:
        values = evaluation_scalars(evaluation)
        self._write(values, run.env_steps)
        if evaluation.final and run.env_steps < run.config.env_steps:
            # An agent that learns nothing, or no more, has this success for the rest of the axis.
            held = {tag: value for tag, value in values.items() if tag.startswith("eval/")}
            self._write(held, run.config.env_steps)

    def saving(self, run: Trainer) -> Mapping[str, Any]:
        # A continued run does not repeat the events before its checkpoint.
        for log in self.logs:
            log.flush()
        return {"recent_episodes": self.recent.state()}

    def finished(self, run: Trainer) -> None:
        for log in self.logs:
            log.finish()

    def failed(self, run: Trainer, error: BaseException) -> None:
        for log in self.logs:
            log.close()

    def picture(self, tag: str, picture: np.ndarray, step: int) -> None:
        """Show a picture ``[height, width, 3]`` uint8."""
        for log in self.logs:
            log.picture(tag, picture, step)

    def film(self, tag: str, frames: Sequence[np.ndarray], rate: float, step: int) -> None:
        """Show pictures of one size, ``rate`` of them per second."""
        for log in self.logs:
            log.film(tag, frames, rate, step)

    def _write_training(self, run: Trainer) -> None:
        seconds = run.seconds
        total = seconds.pop("total")
        self._write(
            {
                **self.recent.take(),
                **self.means.take(),
                **{f"time/{part}": value for part, value in seconds.items()},
                "time/env_steps_per_second": run.env_steps / total,
            },
            run.env_steps,
        )
        self.written = run.env_steps

    def _write(self, values: Mapping[str, float | None], step: int) -> None:
        for log in self.logs:
            log.scalars(values, step)


def evaluation_scalars(evaluation: Evaluation) -> dict[str, float | None]:
    """The scalars of an evaluation, by tag."""
    columns = evaluation.episodes.model_dump(by_alias=True)
    values: dict[str, float | None] = {
        f"eval/{name}": sum(columns[name]) / len(columns[name])
        for name in ("success_once", "success_at_end", "return", "episode_len")
        if None not in columns[name]
    }
    for name, value in evaluation.diagnostics.items():
        # The record holds null for a number that is not finite, and says which.
        kind = evaluation.nonfinite.get(f"diagnostics/{name}")
        if not DETAILS.fullmatch(name):
            values[f"diag/{name}"] = float(kind) if kind else value
    for name in ("equivariance_actor", "equivariance_critic"):
        error = values.get(f"diag/{name}")
        if error is not None:
            values[f"log10/{name}"] = math.log10(max(error, SMALLEST_ERROR))
    return values


def reference_lines(record: RunRecord) -> dict[str, float | None]:
    """Values to compare a run with, by tag. The runs of references are lines themselves."""
    if record.role == "reference":
        return {}
    feasible = record.feasible_q
    return {
        "reference/base_success": record.base_policy.base_success,
        "reference/q_low": feasible.low if feasible else None,
        "reference/q_high": feasible.high if feasible else None,
        "reference/q_magnitude": 1.0 if feasible else None,
    }


class Means:
    """Means of named tensors since the last call of ``take``. Only ``take`` reads the device."""

    def __init__(self) -> None:
        self._sums: dict[str, torch.Tensor] = {}
        self._counts: dict[str, int] = {}

    def add(self, values: Mapping[str, torch.Tensor]) -> None:
        """Count the numbers of each tensor."""
        for name, value in values.items():
            if value.numel():
                total = value.detach().double().sum()
                self._sums[name] = self._sums.get(name, 0.0) + total
                self._counts[name] = self._counts.get(name, 0) + value.numel()

    def take(self) -> dict[str, float]:
        """The means; begins anew."""
        means = {name: (total / self._counts[name]).item() for name, total in self._sums.items()}
        self._sums.clear()
        self._counts.clear()
        return means


class RecentMeans:
    """Running means over the last ``RECENT`` numbers of each name.

    Args:
        state: what :meth:`state` has returned, to continue.
    """

    def __init__(self, state: Mapping[str, Sequence[float]]):
        self._recent = {name: deque(numbers, RECENT) for name, numbers in state.items()}
        self._new: dict[str, list[torch.Tensor]] = {}

    def add(self, values: Mapping[str, torch.Tensor]) -> None:
        """Count the numbers of each tensor; does not read the device."""
        for name, value in values.items():
            if value.numel():
                self._new.setdefault(name, []).append(value.detach())

    def take(self) -> dict[str, float]:
        """The means, of names with any numbers so far."""
        return {name: sum(numbers) / len(numbers) for name, numbers in self.state().items()}

    def state(self) -> dict[str, list[float]]:
        """The last numbers of each name."""
        for name, values in self._new.items():
            recent = self._recent.setdefault(name, deque(maxlen=RECENT))
            recent.extend(torch.cat(values).double().tolist())
        self._new.clear()
        return {name: list(numbers) for name, numbers in self._recent.items()}
