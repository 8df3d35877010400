"""The tables of every cell, and leaderboard.csv."""

from __future__ import annotations

import re

from symsteer.files import csv_text
from symsteer.leaderboard.cell_names import heading
from symsteer.leaderboard.curve_figures import figures_of_cells
from symsteer.leaderboard.known_agents import BASE
from symsteer.leaderboard.records import REPRODUCED, VERDICTS
from symsteer.leaderboard.records.reproductions import Verdict
from symsteer.leaderboard.row_numbers import THRESHOLD
from symsteer.leaderboard.rows import AgentRow, Summary, Table
from symsteer.leaderboard.run_table import cell_columns
from symsteer.leaderboard.sections import Links, Page, Section, View
from symsteer.leaderboard.statistics import Interval
from symsteer.leaderboard.text import (
    NOTHING,
    SPACE,
    code,
    compact,
    count,
    difference,
    ends,
    folded,
    mark_of,
    number,
    share,
    stacked,
    table_text,
)


def render(summary: Summary, view: View) -> list[str]:
    """By task and embodiment, each folded: the figures, then the tables of every cell."""
    return [part for page in pages(summary, view) for part in folded(page.title, page.blocks)]


def pages(summary: Summary, view: View) -> list[Page]:
    """The same, a page for each task and embodiment."""
    places: dict[tuple[str, str], list[Table]] = {}
    for table in summary.tables:
        places.setdefault((table.key.task, table.key.embodiment), []).append(table)
    found = []
    for place, tables in places.items():
        keys = [table.key for table in tables]
        blocks = view.drawn(*place)
        for table in tables:
            blocks += [f"### {heading(table.key, keys)}", *cell_tables(table, view.links)]
        title = ", ".join(place)
        if not all(re.fullmatch(r"[A-Za-z0-9][\w.-]{,60}", word, re.ASCII) for word in place):
            # A name that a record may have, and no task, is shown as code below the title.
            title = "Other cells"
            blocks.insert(0, f"### {', '.join(map(code, place))}")
        found.append(Page(place, title, blocks))
    return found


def cell_tables(table: Table, links: Links) -> list[str]:
    """Both tables and notes of one table, as blocks of markdown."""
    rows = sorted((row for row in table.rows if row.runs), key=_place)
    # Where all runs have ended as they should, their status is no news.
    all_finished = all(status(row) == f"{len(row.runs)}{SPACE}finished" for row in rows)
    results = [
        {"Agent": _name(row)}
        | ({"Rank": _rank(row, table)} if table.is_ranked else {})
        | {
            "Success (final window)": stacked(row.success),
            "Last": number(row.last.value if row.last else None),
            "Against base": stacked(row.difference, sign=True, marks=mark_of(row.difference)),
            "AUC,<br>dip": f"{number(row.area)}<br>{number(row.dip)}",
            f"Steps to {100 * THRESHOLD:.0f}\u00a0%": _steps(row, table.key.env_steps),
            "Seeds \u00d7 episodes": _episodes(row, links),
        }
        | ({} if all_finished else {"Status": status(row)})
        for row in rows
    ]
    parts = [_base_line(table), table_text(results)]
    if absent := [code(row.agent) for row in table.rows if not row.runs]:
        parts.append(f"Not run here: {', '.join(absent)}.")
    if (best := table.best_reference) and best.success:
        against = _of_learners(table, "against_best")
        text = f"Best reference: {code(best.label)}, {number(best.success.value)}."
        parts.append(text + (f" Against it: {against}." if against else ""))
    if rises := _of_learners(table, "rise"):
        parts.append(f"From the fourth to the last fifth of the budget: {rises}.")
    if learners := [row for row in rows if not row.is_reference]:
        diagnostics = [_diagnostics(row, table) for row in learners]
        parts += ["Q-values, symmetry and cost:", table_text(diagnostics, sparse=True)]
    if notes := _notes(table):
        parts.append("\n".join(f"- {note}" for note in notes))
    return parts


def _place(row: AgentRow) -> tuple[bool, bool, float]:
    """References first, then by rank, marked rows last; otherwise the order stays as it is."""
    return row.marked, not row.is_reference, row.rank or float("inf")


def _rank(row: AgentRow, table: Table) -> str:
    if row.rank is None:
        return NOTHING
    tied = sum(other.rank == row.rank for other in table.rows) > 1
    return f"{row.rank}{'=' if tied else ''}"


def _base_line(table: Table) -> str:
    key = table.key
    policies = {run.policy: run.record.base_policy for run in table.counted}
    group = f", group {code(key.group)}" if key.group else ""
    sentences = [
        f"Base policy {code(key.base)}{group}, from {key.demonstrations} {code(key.mode)} "
        f"demonstrations; budget {count(key.env_steps)} environment steps."
    ]

    def over(name: str) -> str:
        values = [v for policy in policies.values() if (v := getattr(policy, name)) is not None]
        return ends(values) if values else "not measured"

    draws = max(policy.draws for policy in policies.values())
    plural = f" ({len(policies)} policies)" if len(policies) > 1 else ""
    sentences.append(
        f"Steerability{plural}: base success {over('base_success')}, spread of actions over the "
        f"noise {over('action_std')}, initial states solved in {draws} draws {over('solvable')}."
    )
    errors = [e for p in policies.values() if (e := p.equivariance_error) is not None]
    if errors:
        sentences[-1] += f" Equivariance error of its actions: {ends(errors, compact)}."
    if table.threshold is not None:
        base = table.row_of(BASE)
        there = base and base.success and base.success.value >= table.threshold
        already = ", where the base policy already is" if there else ""
        sentences.append(f"Steps count to a success of {number(table.threshold)}{already}.")
    return " ".join(sentences)


def _name(row: AgentRow) -> str:
    """An agent's label; below it the environment steps that a reference has searched."""
    if not row.search_steps:
        return code(row.label)
    return f"{code(row.label)}<br>search {count(row.search_steps)}".replace(" ", SPACE)


def _steps(row: AgentRow, budget: int) -> str:
    if not row.threshold_steps:
        return NOTHING
    reached = sum(steps is not None for steps in row.threshold_steps)
    median = row.median_threshold_steps
    text = f"> {count(budget)}" if median is None else count(median)
    return f"{text} ({reached}/{len(row.threshold_steps)})".replace(" ", SPACE)


def _episodes(row: AgentRow, links: Links) -> str:
    """How many finished seeds and episodes; below it every run's seed as a link to its record."""
    seeds = []
    for run in row.runs:
        target = links.get(run.path)
        seeds.append(f"[{run.seed}]({target})" if target else str(run.seed))
    listed = f"<br>{' '.join(seeds)}" if seeds else ""
    counts = row.episodes
    if not counts:
        return NOTHING + listed
    size = str(counts[0]) if len(set(counts)) == 1 else f"{min(counts)} to {max(counts)}"
    return f"{len(counts)} \u00d7 {size}".replace(" ", SPACE) + listed


def status(row: AgentRow) -> str:
    statuses = [run.record.status for run in row.runs] + ["missing"] * row.missing
    order = ("finished", "running", "interrupted", "failed", "missing")
    parts = [f"{statuses.count(status)} {status}" for status in order if status in statuses]
    made_again = row.reproductions
    parts += [f"{made_again[v]} {REPRODUCED[v]}" for v in VERDICTS if made_again[v]]
    return ", ".join(parts).replace(" ", SPACE).replace(f",{SPACE}", ", ")


def _of_learners(table: Table, name: str) -> str:
    """An interval of each learner that has it, by rank."""
    rows = [row for row in sorted(table.learners, key=_place) if getattr(row, name)]
    return "; ".join(f"{code(row.label)} {difference(getattr(row, name))}" for row in rows)


def _diagnostics(row: AgentRow, table: Table) -> dict[str, str]:
    # The header holds the feasible bounds, so that both numbers can be understood.
    bounds = [compact(bound) for bound in table.feasible or ()]
    feasible = f" (feasible Q: {' to '.join(bounds)})" if bounds else ""

    def pair(first: str, second: str) -> str:
        return _pair(row.over_runs(first), row.over_runs(second))

    return {
        "Agent": code(row.label),
        "Q diverged": share(sum(row.diverged), len(row.diverged)),
        f"\\|Q\\| over the largest feasible, overshoot{feasible}": _pair(
            row.largest("magnitude"), row.largest("overshoot")
        ),
        "Q bias, rank correlation": pair("q_bias", "q_rank_correlation"),
        "TD error, orbit variance": pair("td_error", "orbit_variance"),
        "Equivariance error: actor, critic": pair("equivariance_actor", "equivariance_critic"),
        "Parameters: actor, critic (width)": _parameters(row),
        "Minutes a run": _minutes(row),
    }


def _pair(first: float | None, second: float | None) -> str:
    if first is None and second is None:
        return NOTHING
    return f"{compact(first)}<br>{compact(second)}"


def _minutes(row: AgentRow) -> str:
    minutes = [run.record.wall_clock.total / 60 for run in row.finished]
    return number(sum(minutes) / len(minutes), 1) if minutes else NOTHING


def _parameters(row: AgentRow) -> str:
    sizes = {
        (p.actor, p.critic, p.width) for run in row.runs if (p := run.record.parameters).total > 0
    }
    texts = [
        (f"{count(actor)}, {count(critic)}" + f"<br>({width})" * bool(width)).replace(" ", SPACE)
        for actor, critic, width in sorted(sizes, key=str)
    ]
    return "; ".join(texts) or NOTHING


def _notes(table: Table) -> list[str]:
    notes = []
    warnings = {run.record.base_policy.warning for run in table.runs} - {None, ""}
    notes += [f"Base policy: {code(str(warning))}" for warning in sorted(map(str, warnings))]
    for row in table.rows:
        for run in row.runs:
            record = run.record
            if lost := record.not_finite:
                notes.append(f"{code(row.label)}, seed {run.seed}: not finite: {code(lost)}")
            if record.status == "finished":
                continue
            done = record.evaluations[-1].env_steps if record.evaluations else 0
            why = f": {code(record.failure)}" if record.failure else ""
            notes.append(
                f"{code(row.label)}, seed {run.seed}: {record.status}, "
                f"last evaluated after {count(done)} steps{why}"
            )
        if row.runs and row.agent != BASE and row.finished and row.difference is None:
            notes.append(f"{code(row.label)}: no base run on the same episodes to compare with")
    if any(row.label != row.agent for row in table.trusted):
        split = ", ".join(code(row.label) for row in table.trusted if row.label != row.agent)
        notes.append(f"Same agent with different settings, in rows of their own: {split}")
    return notes


CSV_DIAGNOSTICS = (
    "q_mean",
    "q_bias",
    "q_bias_std",
    "q_correlation",
    "q_rank_correlation",
    "q_overestimated",
    "q_off_bias",
    "q_off_rank_correlation",
    "td_error",
    "orbit_variance",
    "alpha",
    "entropy",
    "equivariance_decode",
    "equivariance_actor",
    "equivariance_critic",
)


REPRODUCTION_COLUMNS: dict[str, Verdict] = {
    "reproduced_exactly": "exact",
    "reproduced_alike": "alike",
    "not_reproduced": "different",
}
"""Columns of leaderboards in which a run was made again: the number of such runs."""


def render_csv(summary: Summary) -> str:
    """One line a row of the tables, full precision (6 significant digits), empty where unknown."""
    rows = [_csv_row(table, row) for table in summary.tables for row in table.rows]
    left_out = set() if summary.has_reproductions else set(REPRODUCTION_COLUMNS)
    if not any(table.key.settings for table in summary.tables):
        left_out.add("settings")
    if not summary.has_marks:
        left_out.add("marked")
    rows = [{k: v for k, v in row.items() if k not in left_out} for row in rows]
    return csv_text([rows[0], *(row.values() for row in rows)])


def _csv_row(table: Table, row: AgentRow) -> dict[str, object]:
    key, success, feasible = table.key, row.success, table.feasible
    statuses = [run.record.status for run in row.runs]
    sizes = row.runs[0].record.parameters if row.runs else None
    wall = [run.record.wall_clock.total for run in row.finished]
    return {
        **cell_columns(key),
        "settings": key.settings,
        "agent": row.agent,
        "recipe": row.recipe[:12],
        "rank": row.rank,
        "marked": int(row.marked),
        "runs": len(row.runs),
        **{s: statuses.count(s) for s in ("finished", "failed", "interrupted", "running")},
        "missing": row.missing,
        **{column: row.reproductions[v] for column, v in REPRODUCTION_COLUMNS.items()},
        "episodes": sum(row.episodes),
        "success_iqm": success and success.value,
        "success_low": success and success.low,
        "success_high": success and success.high,
        **_interval("last_checkpoint", row.last),
        **_interval("against_base", row.difference),
        "best_reference": table.best_reference and table.best_reference.label,
        **_interval("against_best", row.against_best),
        **_interval("rise", row.rise),
        "auc": row.area,
        "threshold": table.threshold,
        "threshold_steps": row.median_threshold_steps,
        "search_steps": row.search_steps,
        "threshold_seeds": sum(s is not None for s in row.threshold_steps),
        "dip": row.dip,
        "diverged": sum(row.diverged),
        "with_critic": len(row.diverged),
        **{f"largest_{part}": row.largest(part) for part in ("magnitude", "overshoot", "growth")},
        "feasible_low": feasible and feasible[0],
        "feasible_high": feasible and feasible[1],
        **{name: row.over_runs(name) for name in CSV_DIAGNOSTICS},
        "parameters_actor": sizes and sizes.actor,
        "parameters_critic": sizes and sizes.critic,
        "width": sizes and sizes.width,
        "wall_clock_s": sum(wall) / len(wall) if wall else None,
        "devices": "; ".join(sorted({p.device for run in row.runs for p in run.provenances})),
    }


def _interval(name: str, effect: Interval | None) -> dict[str, object]:
    """A column each for a value and the ends of its interval."""
    numbers = (effect.value, effect.low, effect.high) if effect else (None, None, None)
    return dict(zip((name, f"{name}_low", f"{name}_high"), numbers, strict=True))


SECTION = Section(
    "",
    lambda findings: findings.summary,
    render,
    where="page",
    files={"leaderboard.csv": lambda summary, view: render_csv(summary)},
    figures=lambda summary, _: figures_of_cells(summary),
    apart=pages,
)
