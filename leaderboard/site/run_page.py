"""What the page of a run shows."""

from __future__ import annotations

import re
from collections.abc import Sequence
from statistics import mean
from typing import Any

from symsteer.leaderboard.figures import run_curves
from symsteer.leaderboard.records import REPRODUCED, Evaluation, repeat_command
from symsteer.leaderboard.site.charts import charts, episodes, grouped
from symsteer.leaderboard.site.media import films_of
from symsteer.leaderboard.site.pages import options_of
from symsteer.leaderboard.site.results import Results
from symsteer.leaderboard.summary import Run
from symsteer.leaderboard.text import compact, count, number


def run_values(results: Results, run: Run) -> dict[str, Any]:
    """The values of the template."""
    record, where = run.record, results.row_of.get(run.path)
    settings, policy, budget = record.settings, record.base_policy, record.budget
    table, row = where or (None, None)
    provenance, again = record.provenance, run.reproduction
    sizes = record.parameters
    facts = {
        "status": record.status,
        "failure": record.failure,
        "seed": str(run.seed),
        "success, final window": number(run.success) if run.finished else None,
        "success, last checkpoint": number(record.final.success_once) if record.final else None,
        "Q diverged": None if run.diverged is None else ("yes" if run.diverged else "no"),
        "environment steps": f"{count(budget.env_steps)} of {count(settings.env_steps)}",
        "decisions, updates": f"{count(budget.decisions)}, {count(budget.updates)}",
        "parameters (actor, critics)": f"{count(sizes.actor)}, {count(sizes.critic)}"
        if sizes.total
        else None,
        "started": f"{record.started:%Y-%m-%d %H:%M} UTC",
        "minutes": number(record.wall_clock.total / 60, 1),
        "made again": again and f"{REPRODUCED[again.verdict]} on {again.repeated.ended:%Y-%m-%d}",
        "continued": f"{record.wall_clock.resumed} times" if record.wall_clock.resumed else None,
        "base policy": f"{policy.name} {policy.group or ''}, {policy.content_hash[:12]}",
        "base policy's success": number(policy.base_success),
        "warning": policy.warning,
    }
    made = {
        "commit": provenance.commit
        and provenance.commit + " with changes" * bool(provenance.dirty),
        "version": provenance.version,
        "sha256 of the code": provenance.sha256,
        "device": provenance.device,
        "platform": f"{provenance.platform}, Python {provenance.python}",
        "processor": provenance.processor,
        "packages": ", ".join(f"{name} {v}" for name, v in sorted(provenance.packages.items())),
        "extensions": ", ".join(
            f"{e.kind} {e.target} ({e.distribution or 'not installed'} {e.version or ''})"
            for e in provenance.extensions
        ),
        "configuration": record.config_hash,
    }
    command = repeat_command(record.config)
    last = record.evaluations[-1] if record.evaluations else None
    known = run.agent in results.summary.roles
    return {
        "name": record.run_id,
        "agent_page": results.agent(run.agent) if known else None,
        "label": row.label if row else run.agent,
        "role": record.role,
        "cell": table and (results.names[table.key], results.cell(table.key)),
        "facts": {key: text for key, text in facts.items() if text},
        "made": {key: text for key, text in made.items() if text},
        "command": command and re.split(" (?=--)", command),
        "config": options_of(record.config),
        "charts": charts(run_curves(run)) if run.curve else [],
        "episodes": [episodes(run)] if run.curve else [],
        "evaluations": [_evaluation(evaluation) for evaluation in run.curve.values()],
        "last": _episodes(last) if last else [],
        "diagnostics": [
            (name, compact(value))
            for name, value in sorted(last.diagnostics.items() if last else ())
            if value is not None
        ],
        "films": films_of(run),
    }


def _evaluation(evaluation: Evaluation) -> list[str]:
    """A row of the table of evaluations."""
    columns, diagnostics = evaluation.episodes, evaluation.diagnostics
    bias = diagnostics.get("q_bias", diagnostics.get("q_bias_successful"))
    names = ("td_error", "equivariance_actor", "equivariance_critic")
    return [
        grouped(evaluation.env_steps),
        str(len(columns.seed)),
        number(evaluation.success_once),
        number(_mean(columns.success_at_end)),
        number(_mean(columns.return_), 1),
        number(_mean(columns.episode_len), 1),
        compact(diagnostics.get("q_mean")),
        compact(bias),
        *(compact(diagnostics.get(name)) for name in names),
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
