"""Runs: records with what follows from each of them alone, and how they are read."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from statistics import fmean

import numpy as np

from symsteer.errors import UserError
from symsteer.leaderboard.keys import row_key
from symsteer.leaderboard.paths import record_files
from symsteer.leaderboard.records import (
    Evaluation,
    Provenance,
    Reproduction,
    RunRecord,
    check_reproduction,
    file_hash,
    flat,
    read_record,
    read_reproductions,
)
from symsteer.leaderboard.records.measures import area_under_curve
from symsteer.leaderboard.statistics import Sample, paired_differences
from symsteer.leaderboard.study import AreaFrom, all_listed

FINAL_WINDOW = 5
"""The final window is the last fifth of the budget."""

SAME_POINT = 0.01
"""Evaluations of two runs at most this share of the budget apart belong together: a run is
evaluated after the decision that crosses the planned step, and decisions differ in length."""

Pair = tuple[str, int]
"""Content hash of the base policy and run seed: what paired runs share."""


@dataclass(frozen=True)
class Run:
    """One record and where it was read."""

    path: Path
    record: RunRecord
    reproduction: Reproduction | None = None
    """What the same run said when it was made again."""
    trusted: bool = True
    """Whether it counts: all do but submitted ones that no maintainer has reproduced."""
    digest: str = ""
    """sha256 of the record's file."""
    area_from: AreaFrom = "start"
    """Where the area under the success curve begins."""

    @property
    def seed(self) -> int:
        return self.record.settings.seed

    @property
    def policy(self) -> str:
        """Content hash of the base policy that it steers."""
        return self.record.base_policy.content_hash

    @property
    def pair(self) -> Pair:
        return self.policy, self.seed

    @property
    def agent(self) -> str:
        return self.record.settings.agent

    @property
    def finished(self) -> bool:
        return self.record.status == "finished"

    @property
    def is_reference(self) -> bool:
        return self.record.role == "reference"

    @property
    def provenances(self) -> list[Provenance]:
        """Where the run began and where it was continued."""
        return [self.record.provenance, *self.record.continued]

    @cached_property
    def curve(self) -> dict[int, Evaluation]:
        """Evaluations by env_steps; of two at the same step the later one counts."""
        return {evaluation.env_steps: evaluation for evaluation in self.record.evaluations}

    @property
    def points(self) -> tuple[list[int], list[float]]:
        """Steps and success of the evaluations."""
        return list(self.curve), [evaluation.success_once for evaluation in self.curve.values()]

    @cached_property
    def area_begin(self) -> int:
        """Environment steps at which the area begins; 0 too if there is no warm-up."""
        if self.area_from == "start":
            return 0
        config = flat(self.record.config)
        warmup, execute = config.get("agent_options.warmup"), config.get("policy.execute")
        if not (isinstance(warmup, int) and isinstance(execute, int)):
            return 0
        steps = warmup * execute
        return steps if 0 < steps < self.record.settings.env_steps else 0

    @cached_property
    def final_success(self) -> dict[int, float]:
        """success_once of the final evaluation by episode seed (empty before the end)."""
        return episode_success(self.record.final) if self.record.final else {}

    @cached_property
    def final_window(self) -> dict[int, Evaluation]:
        """The evaluations of the final window by env_steps; empty before the end.

        These are all evaluations in the last fifth of the budget; of a reference it is the one
        final evaluation, at any step.
        """
        final = self.record.final
        if final is None:
            return {}
        start = (FINAL_WINDOW - 1) * self.record.settings.env_steps
        return {
            step: evaluation
            for step, evaluation in self.curve.items()
            if evaluation is final or (not self.is_reference and FINAL_WINDOW * step >= start)
        }

    @cached_property
    def window(self) -> dict[tuple[int, int], float]:
        """success_once in the final window by (env_steps, episode seed); empty before the end."""
        return {
            (step, seed): success
            for step, evaluation in self.final_window.items()
            for seed, success in episode_success(evaluation).items()
        }

    @property
    def success(self) -> float:
        """Share of successful episodes in the final window; the run must be finished."""
        return float(np.mean(list(self.window.values())))

    @property
    def success_sample(self) -> Sample:
        """Success in the final window; the run must be finished."""
        return Sample.pooled(((s, value) for (_, s), value in self.window.items()), self.policy)

    @property
    def area(self) -> float:
        """Area under the success curve; the run must be finished."""
        return area_under_curve(*self.points, self.record.settings.env_steps, self.area_begin)

    @property
    def feasible(self) -> tuple[float, float] | None:
        """Feasible Q bounds, entropy allowance included."""
        bound = self.record.feasible_q
        if bound is None:
            return None
        allowance = max([0.0, *self.diagnostic("q_allowance").values()])
        return bound.low - allowance, bound.high + allowance

    @property
    def diverged(self) -> bool | None:
        """Whether Q diverged; None without a critic and while an unfinished run may still do so."""
        verdict = self.record.diverged
        return verdict if self.finished or verdict else None

    @cached_property
    def rise(self) -> dict[int, float]:
        """Success in the last fifth of the budget minus that in the fifth before it.

        By episode seed, for those that both have; empty before the end.
        """
        if not self.finished:
            return {}
        return paired_differences(self._in_fifth(FINAL_WINDOW), self._in_fifth(FINAL_WINDOW - 1))

    def _in_fifth(self, number: int) -> dict[int, float]:
        """Mean success by episode seed over the evaluations in a fifth of the budget, 1 to 5."""
        values: dict[int, list[float]] = defaultdict(list)
        for step, evaluation in self.curve.items():
            inside = 1 + FINAL_WINDOW * step // self.record.settings.env_steps
            if min(inside, FINAL_WINDOW) == number:
                for seed, success in episode_success(evaluation).items():
                    values[seed].append(success)
        return {seed: fmean(successes) for seed, successes in values.items()}

    def measured(self, measure: str) -> float | None:
        """Final success, area, divergence, largest |Q| over the feasible, |Q bias|; None: unknown.

        A run that failed after Q had diverged counts as diverged; the others need its end.
        """
        if measure == "diverged":
            return None if self.diverged is None else float(self.diverged)
        if not self.finished:
            return None
        if measure in ("success", "auc"):
            return self.success if measure == "success" else self.area
        if measure == "magnitude":
            return self.record.divergence.magnitude if self.record.divergence else None
        biases = [e.diagnostics.get("q_bias") for e in self.final_window.values()]
        known = [bias for bias in biases if bias is not None]
        return abs(float(np.mean(known))) if known and self.record.divergence else None

    def diagnostic(self, name: str) -> dict[int, float]:
        """The finite values of a diagnostic by env_steps."""
        values = {step: e.diagnostics.get(name) for step, e in self.curve.items()}
        return {step: value for step, value in values.items() if value is not None}

    def last(self, *names: str) -> float | None:
        """The final evaluation's value of the first of `names` that was measured."""
        final = self.record.final
        values = [final.diagnostics.get(name) for name in names] if final else []
        return next((value for value in values if value is not None), None)


def episode_success(evaluation: Evaluation) -> dict[int, float]:
    """success_once by episode seed."""
    columns = evaluation.episodes
    return dict(zip(columns.seed, map(float, columns.success_once), strict=True))


def aligned(run: Run, other: Run) -> dict[int, int]:
    """env_steps of `run`'s evaluations -> of those of `other` that belong to them.

    That is the nearest one, if it is at most `SAME_POINT` of the budget away.
    """
    reach = SAME_POINT * run.record.settings.env_steps
    twins = {}
    for step in run.curve:
        twin = min(other.curve, key=lambda there: (abs(there - step), there), default=None)
        if twin is not None and abs(twin - step) <= reach:
            twins[step] = twin
    return twins


def load_runs(
    paths: Iterable[Path],
    reproductions: Path | None = None,
    listed: Collection[str] | None = None,
    area_from: AreaFrom = "start",
) -> list[Run]:
    """Read the records that `paths` name: files, run folders, folders of either.

    `record_files` says which files those are. Raises UserError for a path that names none, for a
    file that is not a valid record, and for a reproduction that does not say what its records say.

    Args:
        paths: of the records.
        reproductions: folder of their reproductions (`read_reproductions`).
        listed: hashes of the records and reproductions that are the study's own (`Study.listed`).
            Others are submitted. A submitted run is trusted if one of its row was reproduced by a
            listed reproduction. None: nothing is known, and all are trusted.
        area_from: where areas under success curves begin (`Study.area_from`).
    """
    known = read_reproductions(reproductions) if reproductions else {}
    vouched = all_listed() if listed is None and known else listed or ()
    runs = []
    for file in record_files(paths):
        record, digest = read_record(file), file_hash(file)
        trusted = listed is None or digest in listed
        runs.append(Run(file, record, known.get(digest), trusted, digest, area_from))
        if reproductions and digest in known:
            path = reproductions / f"{digest}.json"
            counts = file_hash(path) in vouched, listed is None
            check_reproduction(known[digest], path, file, *counts)
    confirmed = {
        row_key(run.record)
        for run in runs
        if not run.trusted and run.reproduction and run.reproduction.verdict != "different"
    }
    runs = [replace(r, trusted=r.trusted or row_key(r.record) in confirmed) for r in runs]
    used = {run.reproduction.record.sha256 for run in runs if run.reproduction}
    present = {run.record.run_id for run in runs}
    for digest in sorted(known.keys() - used):
        if (name := known[digest].record.run_id) in present:
            raise UserError(
                f"{reproductions}/{digest}.json is about a record of {name} that has changed since "
                "then: make it again with `symsteer reproduce`, or remove the file"
            )
    return runs
