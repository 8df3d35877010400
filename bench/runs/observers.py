"""Observers that write the results of a run: the record, and its progress."""

from __future__ import annotations

import contextlib
import json
import time
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal

import torch

from symsteer.agents.agent import HasCritic
from symsteer.bench.runs.base_policy import describe_base
from symsteer.bench.runs.config import content_key
from symsteer.bench.runs.folder import CHECKPOINT, PROGRESS, RECORD
from symsteer.bench.runs.scalars import Means
from symsteer.bench.runs.stored import extensions_of
from symsteer.bench.runs.trainer import Observer, Trainer
from symsteer.bench.steering.seeds import HELD_OUT_SEED
from symsteer.errors import UserError
from symsteer.files import write_atomically
from symsteer.leaderboard.records import (
    Evaluation,
    FeasibleQ,
    Parameters,
    Provenance,
    RunRecord,
    UsedBudget,
    WallClock,
    config_hash,
    read_record,
    write_record,
)
from symsteer.terminal import progress_bar, tell

SHOW_EVERY = 10
"""Decisions (of all environments together) between two changes of the numbers beside the bar."""

PROGRESS_SECONDS = 2.0
"""Shortest time between two writes of progress.json within a phase."""


class RecordWriter(Observer):
    """Keeps record.json: written at the start, after every evaluation, and at the end."""

    record: RunRecord

    def began(self, run: Trainer, checkpoint: Mapping[str, Any] | None) -> None:
        provenance = Provenance.collect(
            device=torch.cuda.get_device_name(run.agent.device)
            if run.agent.device.type == "cuda"
            else "cpu",
            torch_threads=torch.get_num_threads(),
            extensions=extensions_of(run.config),
            together=run.together,
        )
        if checkpoint:
            self._continue(run, checkpoint, provenance)
        else:
            self._open(run, provenance)
        self._write(run)

    def _open(self, run: Trainer, provenance: Provenance) -> None:
        config, counts, feasible = run.config, run.agent.parameter_counts(), run.feasible
        sizes = {key: counts[key] for key in ("actor", "critic", "total")}
        self.record = RunRecord(
            run_id=run.folder.name,
            role=run.agent.role,
            config=dict(run.resolved),
            provenance=provenance,
            seeds={
                "run": config.seed,
                "policy": config.policy_seed,
                "demonstrations": config.demonstrations.seed,
                "first_held_out": HELD_OUT_SEED,
            },
            started=datetime.now(UTC),
            parameters=Parameters(**sizes, width=counts["width"] or None),
            base_policy=describe_base(run.policy),
            feasible_q=FeasibleQ(low=feasible[0], high=feasible[1])
            if isinstance(run.agent, HasCritic)
            else None,
        )

    def _continue(
        self, run: Trainer, checkpoint: Mapping[str, Any], provenance: Provenance
    ) -> None:
        """Restore the record of the checkpoint."""
        self.record = record = read_record(run.folder / RECORD)
        del record.evaluations[checkpoint["evaluations"] :]
        mine = (run.folder.name, config_hash(run.resolved), checkpoint["history"])
        if (record.run_id, record.config_hash, _history(record)) != mine:
            raise UserError(
                f"{run.folder / RECORD} is not the record that {CHECKPOINT} beside it "
                "continues; restore both as they were, or delete the run's folder to start again"
            )
        if provenance not in (record.provenance, *record.continued):
            record.continued = [*record.continued, provenance]
        record.wall_clock.resumed += 1
        record.ended, record.status, record.failure = None, "running", None

    def evaluated(self, run: Trainer, evaluation: Evaluation) -> None:
        self.record.evaluations.append(evaluation)
        self.record.budget = UsedBudget(
            env_steps=run.env_steps, decisions=run.decisions, updates=run.updates
        )
        self.record.wall_clock = WallClock(**run.seconds, resumed=self.record.wall_clock.resumed)
        self._write(run)

    def saving(self, run: Trainer) -> Mapping[str, Any]:
        return {"evaluations": len(self.record.evaluations), "history": _history(self.record)}

    def finished(self, run: Trainer) -> None:
        self._close(run, "finished")

    def failed(self, run: Trainer, error: BaseException) -> None:
        interrupted = isinstance(error, KeyboardInterrupt)
        self.record.failure = (
            "interrupted by the user" if interrupted else f"{type(error).__name__}: {error}"
        )
        # Often the run failed because this folder cannot be written.
        with contextlib.suppress(UserError):
            self._close(run, "interrupted" if interrupted else "failed")

    def _close(self, run: Trainer, status: Literal["finished", "failed", "interrupted"]) -> None:
        self.record.ended = datetime.now(UTC)
        self.record.status = status
        self.record.wall_clock.total = run.seconds["total"]
        self._write(run)

    def _write(self, run: Trainer) -> None:
        write_record(self.record, run.folder / RECORD)


class TerminalProgress(Observer):
    """A progress bar for the terminal, and progress.json for `symsteer status` and sweeps."""

    def __init__(self) -> None:
        self.bar = contextlib.ExitStack()
        self.means = Means()
        self.rounds = 0
        self.success: float | None = None

    def began(self, run: Trainer, checkpoint: Mapping[str, Any] | None) -> None:
        self.file = ProgressFile(run.folder, run.config.env_steps, run.env_steps)

    def entered(self, run: Trainer, phase: str) -> None:
        self.file.write(phase, run.env_steps, self.success)

    def stepped(self, run: Trainer, scalars: Sequence[Mapping[str, torch.Tensor]]) -> None:
        budget = run.config.env_steps
        if not self.rounds:
            bar = progress_bar(run.config.title, budget, run.how.quiet, "step")
            self.advance = self.bar.enter_context(bar)
        self.means.add({k: v for k, v in scalars[0].items() if k == "train/success_once"})
        self.rounds += 1
        shown: dict[str, float | None] = {}
        if self.rounds % SHOW_EVERY == 0:
            success = self.means.take().get("train/success_once")
            shown = {"success": success, "held_out": self.success}
        texts = {name: f"{value:.2f}" for name, value in shown.items() if value is not None}
        self.advance(min(run.env_steps, budget), **texts)
        self.file.write("training", run.env_steps, self.success)

    def evaluated(self, run: Trainer, evaluation: Evaluation) -> None:
        self.success = evaluation.success_once
        if not run.how.quiet:
            count = len(evaluation.episodes.seed)
            tell(
                f"{run.config.title}: {run.env_steps:7d} steps, held-out success "
                f"{self.success:.2f} ({count} episodes{', final' if evaluation.final else ''})"
            )

    def finished(self, run: Trainer) -> None:
        self.bar.close()

    def failed(self, run: Trainer, error: BaseException) -> None:
        self.bar.close()


class ProgressFile:
    """progress.json: the progress of a running run.

    Args:
        folder: of the run.
        budget: control steps that the run may use.
        env_steps: control steps that a continued run has already used.
    """

    def __init__(self, folder: Path, budget: int, env_steps: int = 0):
        self._path, self._budget, self._first = folder / PROGRESS, budget, env_steps
        self._start = time.monotonic()
        self._last = -float("inf")
        self._phase = ""

    def write(self, phase: str, env_steps: int, success: float | None = None) -> None:
        """Write if the phase has changed, or two seconds after the last time."""
        now = time.monotonic()
        if phase == self._phase and now - self._last < PROGRESS_SECONDS:
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
        # Do not stop a run for this file. A full disk is reported when results are written.
        with contextlib.suppress(UserError):
            write_atomically(self._path, json.dumps(data).encode(), durable=False)


def _history(record: RunRecord) -> str:
    """A hash of all evaluations in the record."""
    return content_key(
        [evaluation.model_dump(mode="json", by_alias=True) for evaluation in record.evaluations]
    )
