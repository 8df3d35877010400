"""The scalars of a run for those who watch it: in TensorBoard, and in W&B where it is tracked.

They are the record's numbers, and numbers of training between evaluations. Nothing reads them back.
"""

from __future__ import annotations

import math
import re
from collections import deque
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import torch

from symsteer.bench.runs.pictures import draw_paths
from symsteer.bench.runs.tensorboard import RunLog
from symsteer.bench.runs.tracking import WandbLog
from symsteer.bench.runs.trainer import Observer, Trainer
from symsteer.leaderboard.records import Evaluation, RunRecord
from symsteer.terminal import tell

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


class Scalars(Observer):
    """Writes what the record holds, scalars of training between evaluations, and pictures.

    Args:
        records: the observer that writes the record.
    """

    def __init__(self, records: RecordWriter):
        self.records = records
        self.logs: list[RunLog | WandbLog] = []
        self.means = Means()

    def began(self, run: Trainer, checkpoint: Mapping[str, Any] | None) -> None:
        record = self.records.record
        # Even without a checkpoint, an earlier process may have written events.
        self.logs.append(RunLog(run.folder, record, run.env_steps + 1 if checkpoint else 0))
        if run.how.track:
            self.logs.append(WandbLog(run.folder, record, run.how.group))
        for log in self.logs:
            log.level(reference_lines(record), run.config.env_steps)
        self.recent = Means((checkpoint or {}).get("recent_episodes", {}))
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
        if run.evaluator.played is not None:
            try:
                policy, title = run.policy, run.config.title
                paths = draw_paths(run.evaluator.played, policy.obs_layout, title)
                for log in self.logs:
                    log.picture("eval/paths", paths, run.env_steps)
            except Exception as error:
                if not run.how.quiet:
                    tell(f"no picture of the evaluation: {type(error).__name__}: {error}")
        for log in self.logs:
            log.end(finished=True)

    def failed(self, run: Trainer, error: BaseException) -> None:
        for log in self.logs:
            log.end(finished=False)

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
    episodes = evaluation.episodes.model_dump(by_alias=True)
    values: dict[str, float | None] = {
        f"eval/{name}": sum(episodes[name]) / len(episodes[name])
        for name in ("success_once", "success_at_end", "return", "episode_len")
        if None not in episodes[name]
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
    """Means of named tensors. Only ``take`` and ``state`` read the device.

    Args:
        recent: None for means since the last call of ``take``; or what :meth:`state` has returned,
            for running means over the last ``RECENT`` numbers of each name.
    """

    def __init__(self, recent: Mapping[str, Sequence[float]] | None = None):
        self._limit = None if recent is None else RECENT
        self._numbers = {name: deque(numbers, RECENT) for name, numbers in (recent or {}).items()}
        self._new: dict[str, list[torch.Tensor]] = {}

    def add(self, values: Mapping[str, torch.Tensor]) -> None:
        """Count the numbers of each tensor."""
        for name, value in values.items():
            if value.numel():
                # A copy: the agent may use the same memory again.
                number = value.detach().flatten().to(torch.float64, copy=True)
                self._new.setdefault(name, []).append(number)

    def take(self) -> dict[str, float]:
        """The means, of names with any numbers."""
        means = {name: sum(numbers) / len(numbers) for name, numbers in self.state().items()}
        if self._limit is None:
            self._numbers.clear()
        return means

    def state(self) -> dict[str, list[float]]:
        """The numbers of each name that the next means are of."""
        for name, values in self._new.items():
            numbers = self._numbers.setdefault(name, deque(maxlen=self._limit))
            numbers.extend(torch.cat(values).tolist())
        self._new.clear()
        return {name: list(numbers) for name, numbers in self._numbers.items()}
