"""Outcomes of trials as data: what was tried, how good it was, what is chosen."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from pydantic import TypeAdapter
from scipy.stats import rankdata

from symsteer.bench.runs.config import RunConfig
from symsteer.bench.runs.folder import RECORD, run_id
from symsteer.errors import UserError, first_problem
from symsteer.leaderboard.records import read_record
from symsteer.leaderboard.records.measures import area_under_curve
from symsteer.tables import aligned

START = 0
"""Number of the trial with which each search begins."""


@dataclass(frozen=True)
class Score:
    """One finished run.

    Attributes:
        cell: task, embodiment, variant and seed.
        auc: area under the curve of held-out success, as a share of the budget.
        success: in the final evaluation.
        seconds: wall-clock time of the run.
        finite: whether every Q-value was; None if that was not looked at.
    """

    cell: str
    auc: float
    success: float
    seconds: float
    finite: bool | None = None

    @property
    def task(self) -> str:
        """Name of the task."""
        return self.cell.split()[0]

    @property
    def policy(self) -> str:
        """The base policy: that of a task, an embodiment and a seed."""
        task, embodiment, _, seed = self.cell.split()
        return f"{task} {embodiment} {seed}"


State = Literal["complete", "pruned", "failed"]

Setting = Literal["start", "one_option", "chosen", "by_task"]
"""Settings that are compared on fresh cells: the first trial's, these with one option of the
choice, the choice, and a choice for each task."""


@dataclass(frozen=True)
class TrialResult:
    """One trial of an agent.

    Attributes:
        number: from 0; trial 0 has those of the plan's start.
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
    """The setting of an agent, and how it compares with others on fresh cells.

    Attributes:
        trial: its number.
        rank: mean over the cells of its rank among the complete trials; 1 is best.
        start_rank: the same of the first trial.
        by_task: number of the trial that is best on the cells of one task.
        singles: scores on the cells of trials of the first trial with one option of the choice.
        fresh: scores on fresh cells.
    """

    agent: str
    trial: int
    options: Mapping[str, Any]
    rank: float
    start_rank: float
    by_task: Mapping[str, int]
    singles: Mapping[str, Sequence[Score]] = field(default_factory=dict)
    fresh: Mapping[Setting, Sequence[Score]] = field(default_factory=dict)


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
        not record.nonfinite_q,
    )


def read_scores(path: Path) -> dict[str, Score]:
    """Scores by run, as ``symsteer tune`` keeps them; none if there is no such file.

    Raises:
        UserError: if the file cannot be read as scores.
    """
    if not path.is_file():
        return {}
    try:
        return TypeAdapter(dict[str, Score]).validate_json(path.read_bytes())
    except ValueError as error:
        raise UserError(
            f"{path} is not a file of scores ({first_problem(error)}); delete it, and the search "
            "goes on with the runs whose folders are there"
        ) from None


def mean_auc(scores: Sequence[Score]) -> float:
    """Mean area under the curve over runs."""
    return float(np.mean([score.auc for score in scores]))


def mean_ranks(settings: Sequence[Sequence[Score]]) -> list[float]:
    """Mean rank of settings over the same cells by their areas; ties share their mean rank."""
    areas = np.array([[score.auc for score in scores] for scores in settings])
    return rankdata(-areas, axis=0).mean(axis=1).tolist()


def choose(trials: Sequence[TrialResult]) -> Chosen | None:
    """The complete trial of an agent with the best mean rank; None if the first trial failed.

    Ranks, because areas of an easy and of a hard cell have different ranges.
    """
    complete = [trial for trial in trials if trial.state == "complete"]
    if not complete or complete[0].number != START:
        return None
    ranks = mean_ranks([trial.scores for trial in complete])
    best = int(np.argmin(ranks))
    trial, by_task = complete[best], {}
    for task in dict.fromkeys(score.task for score in trial.scores):
        cells = [[score for score in one.scores if score.task == task] for one in complete]
        by_task[task] = complete[int(np.argmin(mean_ranks(cells)))].number
    return Chosen(
        agent=trial.agent,
        trial=trial.number,
        options=trial.options,
        rank=ranks[best],
        start_rank=ranks[0],
        by_task=by_task,
    )


def best_single(chosen: Chosen, start: Sequence[Score]) -> str | None:
    """The option whose chosen value alone has the best mean rank; None: the first trial has.

    Args:
        chosen: with ``singles``.
        start: scores of the first trial on the same cells.
    """
    names = [None, *chosen.singles]
    return names[int(np.argmin(mean_ranks([start, *chosen.singles.values()])))]


def to_json(trials: Sequence[TrialResult], chosen: Sequence[Chosen]) -> dict[str, Any]:
    """Plain data."""
    return {
        "trials": [dataclasses.asdict(trial) for trial in trials],
        "chosen": [dataclasses.asdict(choice) for choice in chosen],
    }


def from_json(data: Mapping[str, Any]) -> tuple[list[TrialResult], list[Chosen]]:
    """The opposite of :func:`to_json`.

    Raises:
        UserError: if the data are not those of a search.
    """
    try:
        trials = TypeAdapter(list[TrialResult]).validate_python(data["trials"])
        return trials, TypeAdapter(list[Chosen]).validate_python(data["chosen"])
    except (LookupError, TypeError, ValueError) as error:
        raise UserError(
            f"these are not the trials of a search ({first_problem(error)}); name the file "
            "PLAN.json that `symsteer tune` wrote"
        ) from None


def to_text(trials: Sequence[TrialResult], chosen: Sequence[Chosen]) -> str:
    """A table with a row for each agent that has a chosen setting."""
    header = ["agent", "trials", "pruned", "failed", "chosen", "rank", "of start"]
    header += ["AUC", "of start", "fresh: start", "one option", "chosen", "by task"]
    lines = []
    for choice in chosen:
        results = {trial.number: trial for trial in trials if trial.agent == choice.agent}
        states = [result.state for result in results.values()]
        counts = len(results), states.count("pruned"), states.count("failed"), choice.trial
        ranks = choice.rank, choice.start_rank
        areas = results[choice.trial].auc, results[START].auc
        fresh = [choice.fresh.get(setting) for setting in get_args(Setting)]
        lines.append(
            [
                choice.agent,
                *map(str, counts),
                *(f"{rank:.2f}" for rank in ranks),
                *(f"{area:.3f}" for area in areas),
                *(f"{mean_auc(scores):.3f}" if scores else "-" for scores in fresh),
            ]
        )
    return aligned(header, lines)


def to_preset(chosen: Sequence[Chosen], comment: str) -> str:
    """The chosen settings as a preset, TOML."""
    lines = [f"# {comment}"]
    for choice in chosen:
        lines += ["", f"[{choice.agent}]"]
        for name, value in choice.options.items():
            number = float(f"{value:.4g}") if isinstance(value, float) else value
            lines.append(f"{name} = {json.dumps(number)}")
    return "\n".join(lines) + "\n"
