"""What the page of a run shows."""

from __future__ import annotations

import re
from typing import Any

from symsteer.leaderboard.records import REPRODUCED, Evaluation, repeat_command
from symsteer.leaderboard.site import charts
from symsteer.leaderboard.site.board import Board, dials
from symsteer.leaderboard.site.clips import media
from symsteer.leaderboard.site.pages import options_of
from symsteer.leaderboard.summary import Run
from symsteer.leaderboard.text import compact, count, number


def run_values(board: Board, run: Run) -> dict[str, Any]:
    """The values of the template."""
    record, where = run.record, board.row_of.get(run.path)
    settings, policy = record.settings, record.base_policy
    table, row = where or (None, None)
    provenance, again = record.provenance, run.reproduction
    commit = provenance.commit and provenance.commit + (" with changes" * bool(provenance.dirty))
    facts = {
        "status": record.status,
        "failure": record.failure,
        "seed": str(run.seed),
        "success, final window": number(run.success) if run.finished else None,
        "success, last checkpoint": number(record.final.success_once) if record.final else None,
        "Q diverged": None if run.diverged is None else ("yes" if run.diverged else "no"),
        "environment steps": f"{count(record.budget.env_steps)} of {count(settings.env_steps)}",
        "decisions, updates": f"{count(record.budget.decisions)}, {count(record.budget.updates)}",
        "parameters (actor, critics)": f"{count(record.parameters.actor)}, "
        f"{count(record.parameters.critic)}"
        if record.parameters.total
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
        "commit": commit,
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
    return {
        "name": record.run_id,
        "agent": run.agent,
        "agent_page": f"../{board.agent(run.agent)}" if run.agent in board.summary.roles else None,
        "label": row.label if row else run.agent,
        "role": record.role,
        "cell": table and (board.names[table.key], f"../{board.cell(table.key)}"),
        "dials": [(name, f"../{board.variant(name)}") for name in dials(settings.variant)]
        if table
        else [],
        "facts": {key: text for key, text in facts.items() if text},
        "made": {key: text for key, text in made.items() if text},
        "command": command and re.split(" (?=--)", command),
        "config": options_of(record.config),
        "charts": charts.run_charts(record, run, run.feasible) if run.curve else [],
        "episodes": charts.episodes_chart(run) if run.curve else None,
        "evaluations": [_evaluation(evaluation) for evaluation in run.curve.values()],
        "last": _episodes(record.evaluations[-1]) if record.evaluations else [],
        "diagnostics": [
            (name, compact(value))
            for name, value in sorted(record.evaluations[-1].diagnostics.items())
            if value is not None
        ]
        if record.evaluations
        else [],
        "media": [(f"../{address}", kind, name) for address, kind, name, _ in media(run)],
    }


def _mean(values: list[Any]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def _evaluation(evaluation: Evaluation) -> list[str]:
    """A row of the table of evaluations."""
    episodes, diagnostics = evaluation.episodes, evaluation.diagnostics
    bias = diagnostics.get("q_bias", diagnostics.get("q_bias_successful"))
    return [
        f"{evaluation.env_steps:,}".replace(",", "\u202f"),
        str(len(episodes.seed)),
        number(evaluation.success_once),
        number(_mean(list(episodes.success_at_end))),
        number(_mean(list(episodes.return_)), 1),
        number(_mean(list(episodes.episode_len)), 1),
        compact(diagnostics.get("q_mean")),
        compact(bias),
        compact(diagnostics.get("td_error")),
        compact(diagnostics.get("equivariance_actor")),
        compact(diagnostics.get("equivariance_critic")),
    ]


def _episodes(evaluation: Evaluation) -> list[list[str]]:
    """Rows of the table of the last evaluation's episodes."""
    columns = evaluation.episodes
    flags = zip(columns.success_once, columns.success_at_end, strict=True)
    successes = [["yes" if flag else "no" for flag in both] for both in flags]
    numbers = zip(columns.seed, successes, columns.return_, columns.episode_len, strict=True)
    return [[str(seed), *both, number(ret, 1), str(length)] for seed, both, ret, length in numbers]
