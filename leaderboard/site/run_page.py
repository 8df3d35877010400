"""The pages of runs: one a cell, whose data a script shows as the run that the address names."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from statistics import fmean
from typing import Any

from symsteer.leaderboard.curve_figures import run_curves
from symsteer.leaderboard.records import REPRODUCED, Evaluation, repeat_command
from symsteer.leaderboard.runs import Run
from symsteer.leaderboard.site.charts import charts, episodes, grouped
from symsteer.leaderboard.site.markup import shown
from symsteer.leaderboard.site.media import films_of
from symsteer.leaderboard.site.pages import Values, options_of
from symsteer.leaderboard.site.results import Results
from symsteer.leaderboard.text import compact, count, number


def run_pages(results: Results) -> Iterator[tuple[str, str, Values]]:
    """Address, template and values of the pages of runs."""
    for address, runs in results.run_pages.items():
        table, _ = results.row_of.get(runs[0].path) or (None, None)
        agents = dict.fromkeys(run.agent for run in runs)
        aside = [(name, [run for run in runs if run.agent == name]) for name in agents]
        named = {results.run_names[run.path]: run for run in runs}
        data = {name: run_values(results, run) for name, run in named.items()}
        entries = [_entries(run) for run in named.values()]
        # Most of them are those of all runs of the cell.
        shared = set.intersection(*(set(one.items()) for one in entries))
        for one, values in zip(entries, data.values(), strict=True):
            values["record"] = _printable(dict(pair for pair in one.items() if pair not in shared))
        yield (
            address,
            "run.html",
            {
                "cell": table and (results.names[table.key], results.cell(table.key)),
                "runs": results.runs_of(table) if table else aside,
                "data": {"shared": _printable(dict(sorted(shared))), "runs": data},
            },
        )


def _entries(run: Run) -> dict[str, str]:
    """All of a record but its evaluations."""
    every = run.record.model_dump(mode="json", by_alias=True, exclude={"evaluations"})
    return {key: text for key, text in options_of(every) if text != "null"}


def run_values(results: Results, run: Run) -> Values:
    """What the script shows of a run; its texts without control characters."""
    record, again = run.record, run.reproduction
    _, row = results.row_of.get(run.path) or (None, None)
    budget = record.settings.env_steps
    facts = {
        "status": record.status,
        "role": record.role,
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
    texts = {
        "name": record.run_id,
        "agent": row.label if row else run.agent,
        "page": results.agent(run.agent) if run.agent in results.summary.roles else None,
        "facts": {key: text for key, text in facts.items() if text},
        "commit": record.provenance.commit,
        "version": record.provenance.version,
        "command": re.split(" (?=--)", command) if command else [],
        "films": [(one.address, one.text, one.is_film) for one in films_of(run)],
    }
    return _printable(texts) | {
        "charts": charts(run_curves(run)) if run.curve else [],
        "episodes": run.curve and episodes(run),
        "evaluations": [
            [*map(shown, header)],
            *(_evaluation(e, measured) for e in run.curve.values()),
        ],
    }


def _printable(value: Any) -> Any:
    """The same data with texts that pages show (`shown`)."""
    if isinstance(value, Mapping):
        return {shown(key): _printable(one) for key, one in value.items()}
    return [*map(_printable, value)] if isinstance(value, list | tuple) else shown(value)


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
    return fmean(known) if known else None
