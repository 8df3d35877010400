"""Outcomes of trials as data: what was tried, how good it was, what is chosen."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from scipy.stats import rankdata

from symsteer.bench.runs.config import RunConfig
from symsteer.bench.runs.folder import RECORD, run_id
from symsteer.leaderboard.records import read_record
from symsteer.leaderboard.records.curves import area_under_curve

DEFAULTS = 0
"""Number of the trial with the agent's defaults."""


@dataclass(frozen=True)
class Score:
    """One finished run.

    Attributes:
        cell: task, embodiment, variant and seed.
        auc: area under the curve of held-out success, as a share of the budget.
        success: in the final evaluation.
        seconds: wall-clock time of the run.
    """

    cell: str
    auc: float
    success: float
    seconds: float


State = Literal["complete", "pruned", "failed"]


@dataclass(frozen=True)
class TrialResult:
    """One trial of an agent.

    Attributes:
        number: from 0; trial 0 has the agent's defaults.
        state: ``pruned`` trials were given up after the first cells.
        options: those that were tuned.
        scores: of its finished runs, in the order of the cells.
    """

    agent: str
    number: int
    state: State
    options: Mapping[str, Any]
    scores: Sequence[Score]

    @property
    def auc(self) -> float:
        """Mean over its runs."""
        return mean_auc(self.scores)


@dataclass(frozen=True)
class Chosen:
    """The setting of an agent, and how it compares with the defaults on fresh cells.

    Attributes:
        trial: its number.
        rank: mean over the cells of its rank among the complete trials; 1 is best.
        default_rank: the same of the defaults.
        confirmed, default_confirmed: scores on fresh cells; empty before they were run.
    """

    agent: str
    trial: int
    options: Mapping[str, Any]
    rank: float
    default_rank: float
    confirmed: Sequence[Score] = field(default_factory=list)
    default_confirmed: Sequence[Score] = field(default_factory=list)


def score_of(config: RunConfig, out: Path) -> Score | None:
    """The score of a run; None if it is not finished."""
    folder = out / run_id(config, {})
    if not (folder / RECORD).is_file():
        return None
    record = read_record(folder / RECORD)
    if record.status != "finished" or record.final is None:
        return None
    steps = [evaluation.env_steps for evaluation in record.evaluations]
    successes = [evaluation.success_once for evaluation in record.evaluations]
    return Score(
        f"{config.task} {config.embodiment} {config.variant} s{config.seed}",
        area_under_curve(steps, successes, config.env_steps),
        record.final.success_once,
        record.wall_clock.total,
    )


def mean_auc(scores: Sequence[Score]) -> float:
    """Mean area under the curve over runs."""
    return float(np.mean([score.auc for score in scores]))


def mean_ranks(trials: Sequence[TrialResult]) -> list[float]:
    """Mean rank of complete trials over the cells by their areas; ties share their mean rank."""
    areas = np.array([[score.auc for score in trial.scores] for trial in trials])
    return rankdata(-areas, axis=0).mean(axis=1).tolist()


def choose(trials: Sequence[TrialResult]) -> Chosen | None:
    """The complete trial of an agent with the best mean rank; None if the defaults failed.

    Ranks, because areas of an easy and of a hard cell have different ranges.
    """
    complete = [trial for trial in trials if trial.state == "complete"]
    if not complete or complete[0].number != DEFAULTS:
        return None
    ranks = mean_ranks(complete)
    best = int(np.argmin(ranks))
    found = complete[best]
    return Chosen(found.agent, found.number, found.options, ranks[best], ranks[0])


def to_json(trials: Sequence[TrialResult], chosen: Sequence[Chosen]) -> dict[str, Any]:
    """Plain data."""
    return {
        "trials": [dataclasses.asdict(trial) for trial in trials],
        "chosen": [dataclasses.asdict(choice) for choice in chosen],
    }


def to_text(trials: Sequence[TrialResult], chosen: Sequence[Chosen]) -> str:
    """A table with a row for each agent that has a chosen setting."""
    header = ["agent", "trials", "pruned", "failed", "chosen", "rank", "of defaults"]
    header += ["AUC", "of defaults", "fresh AUC", "of defaults"]
    rows = [header]
    for choice in chosen:
        own = [trial for trial in trials if trial.agent == choice.agent]
        states = [trial.state for trial in own]
        by_number = {trial.number: trial for trial in own}
        fresh = [
            f"{mean_auc(scores):.3f}" if scores else "-"
            for scores in (choice.confirmed, choice.default_confirmed)
        ]
        rows.append(
            [
                choice.agent,
                *(str(n) for n in (len(own), states.count("pruned"), states.count("failed"))),
                str(choice.trial),
                f"{choice.rank:.2f}",
                f"{choice.default_rank:.2f}",
                f"{by_number[choice.trial].auc:.3f}",
                f"{by_number[DEFAULTS].auc:.3f}",
                *fresh,
            ]
        )
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join(
            text.rjust(width) if i else text.ljust(width)
            for i, (text, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    )


def to_preset(chosen: Sequence[Chosen], comment: str) -> str:
    """The chosen settings as a preset, TOML."""
    lines = [f"# {comment}"]
    for choice in chosen:
        lines += ["", f"[{choice.agent}]"]
        lines += [f"{name} = {_toml(value)}" for name, value in choice.options.items()]
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    return f"{value:.4g}" if isinstance(value, float) else str(value)
