"""What the page of a run shows."""

from __future__ import annotations

import re
from collections.abc import Sequence
from statistics import mean
from typing import Any

from symsteer.leaderboard.curve_figures import run_curves
from symsteer.leaderboard.records import REPRODUCED, Evaluation, repeat_command
from symsteer.leaderboard.runs import Run
from symsteer.leaderboard.site.charts import charts, episodes, grouped
from symsteer.leaderboard.site.media import films_of
from symsteer.leaderboard.site.pages import options_of
from symsteer.leaderboard.site.results import Results
from symsteer.leaderboard.text import compact, count, number


def run_values(results: Results, run: Run) -> dict[str, Any]:
    """The values of the template."""
    record, again = run.record, run.reproduction
    table, row = results.row_of.get(run.path) or (None, None)
    budget = record.settings.env_steps
    facts = {
        "status": record.status,
        "failure": record.failure,
        "seed": str(run.seed),
        "success, final window": number(run.success) if run.finished else None,
        "success, last checkpoint": number(record.final.success_once) if record.final else None,
        "base policy's success": number(record.base_policy.base_success),
        "Q diverged": None if run.diverged is None else ("yes" if run.diverged else "no"),
        "environment steps": f"{count(record.budget.env_steps)} of {count(budget)}",
        "minutes": number(record.wall_clock.total / 60, 1),
        "made again": again and f"{REPRODUCED[again.verdict]} on {again.repeated.ended:%Y-%m-%d}",
        "warning": record.base_policy.warning,
    }
    command = repeat_command(record.config)
    measured = sorted({name for e in run.curve.values() for name in e.diagnostics})
    header = ["Steps", "Episodes", "Success once", "Success at end", "Return", "Length", *measured]
    every = record.model_dump(mode="json", by_alias=True, exclude={"evaluations"})
    return {
        "name": record.run_id,
        "agent_page": results.agent(run.agent) if run.agent in results.summary.roles else None,
        "label": row.label if row else run.agent,
        "role": record.role,
        "cell": table and (results.names[table.key], results.cell(table.key)),
        "facts": {key: text for key, text in facts.items() if text},
        "commit": record.provenance.commit,
        "version": record.provenance.version,
        "command": command and re.split(" (?=--)", command),
        "record": [(key, text) for key, text in options_of(every) if text != "null"],
        "charts": charts(run_curves(run)) if run.curve else [],
        "episodes": [episodes(run)] if run.curve else [],
        "evaluations": (header, [_evaluation(e, measured) for e in run.curve.values()]),
        "last": _episodes(record.evaluations[-1]) if record.evaluations else [],
        "films": films_of(run),
    }


def _evaluation(evaluation: Evaluation, measured: Sequence[str]) -> list[str]:
    """A row of the table of evaluations; diagnostics come last."""
    columns = evaluation.episodes
    return [
        grouped(evaluation.env_steps),
        str(len(columns.seed)),
        number(evaluation.success_once),
        number(_mean(columns.success_at_end)),
        number(_mean(columns.return_), 1),
        number(_mean(columns.episode_len), 1),
        *(compact(evaluation.diagnostics.get(name)) for name in measured),
    ]


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return mean(known) if known else None


def _episodes(evaluation: Evaluation) -> list[list[str]]:
    """Rows of the table of the last evaluation's episodes."""
    columns = evaluation.episodes
    flags = zip(columns.success_once, columns.success_at_end, strict=True)
    successes = [["yes" if flag else "no" for flag in both] for both in flags]
    numbers = zip(columns.seed, successes, columns.return_, columns.episode_len, strict=True)
    return [[str(seed), *both, number(ret, 1), str(length)] for seed, both, ret, length in numbers]
