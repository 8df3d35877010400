"""The tables of one task, embodiment and variant, and leaderboard.csv."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from symsteer.files import csv_text
from symsteer.leaderboard.paper import BASE
from symsteer.leaderboard.records import REPRODUCED, VERDICTS
from symsteer.leaderboard.records.reproductions import Verdict
from symsteer.leaderboard.statistics import Interval
from symsteer.leaderboard.summary import ARM, THRESHOLD, Key, Row, Summary, Table
from symsteer.leaderboard.text import (
    MARKS,
    NOTHING,
    SPACE,
    code,
    compact,
    count,
    difference,
    number,
    share,
    stacked,
    without_empty,
)
from symsteer.tables import markdown

Links = Mapping[Path, str | None]
"""Address of each record relative to the page, None to show none."""


def broken_by(key: Key) -> str:
    return " and ".join(part if part == ARM else code(part) for part in key.broken_by)


def cell_name(table: Table, summary: Summary) -> str:
    """Task, embodiment and variant, and of the rest of the key what tells the tables apart."""
    key = table.key
    name = f"{code(key.task)} {code(key.embodiment)} {broken_by(key) or 'unbroken'}"
    keys = [other.key for other in summary.tables]
    if len({other.base + other.group for other in keys}) > 1:
        name += f" {code((key.base + ' ' + key.group).strip())}"
    if len({(other.mode, other.demonstrations) for other in keys}) > 1:
        name += f" {code(f'{key.demonstrations} {key.mode}')}"
    if len({other.env_steps for other in keys}) > 1:
        name += f" {count(key.env_steps)}"
    if key.settings:
        name += f" {code(key.settings)}"
    return name


def beside_variant(key: Key, others: Sequence[Key]) -> list[str]:
    """Demonstrations and steps, where other tables of the same place and variant differ in them."""
    same = [other for other in others if (other.place, other.variant) == (key.place, key.variant)]
    words = []
    if len({other.demonstrations for other in same}) > 1:
        words.append(f"{key.demonstrations} demonstrations")
    if len({other.env_steps for other in same if other.demonstrations == key.demonstrations}) > 1:
        words.append(f"{count(key.env_steps)} steps")
    return words


def heading(key: Key, others: Sequence[Key]) -> str:
    """What breaks the symmetry, and how the table differs from others of its place and break."""
    broken = broken_by(key)
    words = [f"Broken by {broken}" if broken else "Unbroken symmetry"]
    words += beside_variant(key, others)
    if key.settings:
        words.append(code(key.settings))
    return ", ".join(words)


def section(table: Table, links: Links) -> list[str]:
    """Both tables and notes of one table, as blocks of markdown."""
    key = table.key
    parts = [_base_line(table)]
    header = [
        "Agent",
        "Success (final window)",
        "Last",
        "Against base",
        "AUC,<br>dip",
        f"Steps to {100 * THRESHOLD:.0f}\u00a0%",
        "Seeds \u00d7 episodes",
    ]
    # Where all runs have ended as they should, their status is no news.
    there = [row for row in table.rows if row.runs]
    shows_status = any(status(row) != f"{len(row.runs)}{SPACE}finished" for row in there)
    if shows_status:
        header.append("Status")
    if table.is_ranked:
        header.insert(0, "Rank")
    rows = []
    for row in sorted(there, key=_place):
        cells = [
            _name(row),
            stacked(row.success),
            number(row.last.value if row.last else None),
            stacked(row.difference, True, MARKS[row.difference.sign] if row.difference else ""),
            f"{number(row.area)}<br>{number(row.dip)}",
            _steps(row, key.env_steps),
            _episodes(row, links),
            *([status(row)] if shows_status else []),
        ]
        rows.append([_rank(row, table), *cells] if table.is_ranked else cells)
    parts.append(markdown(header, rows, left=2 if table.is_ranked else 1))
    if absent := [code(row.agent) for row in table.rows if not row.runs]:
        parts.append(f"Not run here: {', '.join(absent)}.")
    parts += [*_against_best(table), *_plateau(table), *_diagnostics(table)]
    if notes := _notes(table):
        parts.append("\n".join(f"- {note}" for note in notes))
    return parts


def _place(row: Row) -> tuple[bool, bool, float]:
    """References first, then by rank, marked rows last; otherwise the order stays as it is."""
    return row.marked, not row.is_reference, row.rank or float("inf")


def _rank(row: Row, table: Table) -> str:
    if row.rank is None:
        return NOTHING
    tied = sum(other.rank == row.rank for other in table.rows) > 1
    return f"{row.rank}{'=' if tied else ''}"


def _base_line(table: Table) -> str:
    key = table.key
    policies = {run.policy: run.record.base_policy for run in table.counted}
    group = f", group {code(key.group)}" if key.group else ""
    text = [
        f"Base policy {code(key.base)}{group}, from {key.demonstrations} {code(key.mode)} "
        f"demonstrations; budget {count(key.env_steps)} environment steps."
    ]

    def over(name: str, digits: int = 2) -> str:
        values = [v for policy in policies.values() if (v := getattr(policy, name)) is not None]
        if not values:
            return "not measured"
        low, high = number(min(values), digits), number(max(values), digits)
        return low if low == high else f"{low} to {high}"

    draws = max(policy.draws for policy in policies.values())
    plural = f" ({len(policies)} policies)" if len(policies) > 1 else ""
    text.append(
        f"Steerability{plural}: base success {over('base_success')}, spread of actions over the "
        f"noise {over('action_std')}, initial states solved in {draws} draws {over('solvable')}."
    )
    errors = [e for p in policies.values() if (e := p.equivariance_error) is not None]
    if errors:
        ends = dict.fromkeys((compact(min(errors)), compact(max(errors))))
        text[-1] += f" Equivariance error of its actions: {' to '.join(ends)}."
    if table.threshold is not None:
        base = table.row_of(BASE)
        there = base and base.success and base.success.value >= table.threshold
        already = ", where the base policy already is" if there else ""
        text.append(f"Steps count to a success of {number(table.threshold)}{already}.")
    return " ".join(text)


def _name(row: Row) -> str:
    """An agent's label; below it the environment steps that a reference has searched."""
    if not row.search_steps:
        return code(row.label)
    return f"{code(row.label)}<br>search {count(row.search_steps)}".replace(" ", SPACE)


def _steps(row: Row, budget: int) -> str:
    if not row.threshold_steps:
        return NOTHING
    reached = sum(steps is not None for steps in row.threshold_steps)
    median = row.median_threshold_steps
    text = f"> {count(budget)}" if median is None else count(median)
    return f"{text} ({reached}/{len(row.threshold_steps)})".replace(" ", SPACE)


def _episodes(row: Row, links: Links) -> str:
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


def status(row: Row) -> str:
    found = [run.record.status for run in row.runs] + ["missing"] * row.missing
    order = ("finished", "running", "interrupted", "failed", "missing")
    parts = [f"{found.count(status)} {status}" for status in order if status in found]
    made_again = row.reproductions
    parts += [f"{made_again[v]} {REPRODUCED[v]}" for v in VERDICTS if made_again[v]]
    return ", ".join(parts).replace(" ", SPACE).replace(f",{SPACE}", ", ")


def _against_best(table: Table) -> list[str]:
    best = table.best_reference
    if best is None or best.success is None:
        return []
    text = f"Best reference: {code(best.label)}, {number(best.success.value)}."
    against = _of_learners(table, "against_best")
    return [text + (f" Against it: {against}." if against else "")]


def _plateau(table: Table) -> list[str]:
    rises = _of_learners(table, "rise")
    return [f"From the fourth to the last fifth of the budget: {rises}."] if rises else []


def _of_learners(table: Table, name: str) -> str:
    """An interval of each learner that has it, by rank."""
    rows = [row for row in sorted(table.learners, key=_place) if getattr(row, name)]
    return "; ".join(f"{code(row.label)} {difference(getattr(row, name))}" for row in rows)


def _diagnostics(table: Table) -> list[str]:
    rows = [row for row in table.rows if row.runs and not row.is_reference]
    if not rows:
        return []
    rows.sort(key=_place)
    columns = {
        "Q diverged": [share(sum(row.diverged), len(row.diverged)) for row in rows],
        _magnitude_header(table): [
            _pair(row.largest("magnitude"), row.largest("overshoot")) for row in rows
        ],
        "Q bias, rank correlation": [
            _pair(row.over_runs("q_bias"), row.over_runs("q_rank_correlation")) for row in rows
        ],
        "TD error, orbit variance": [
            _pair(row.over_runs("td_error"), row.over_runs("orbit_variance")) for row in rows
        ],
        "Equivariance error: actor, critic": [
            _pair(row.over_runs("equivariance_actor"), row.over_runs("equivariance_critic"))
            for row in rows
        ],
        "Parameters: actor, critic (width)": [_parameters(row) for row in rows],
        "Minutes a run": [_minutes(row) for row in rows],
    }
    header, body = without_empty(columns)
    body = [[code(row.label), *texts] for row, texts in zip(rows, body, strict=True)]
    return ["Q-values, symmetry and cost:", markdown(["Agent", *header], body, left=1)]


def _pair(first: float | None, second: float | None) -> str:
    if first is None and second is None:
        return NOTHING
    return f"{compact(first)}<br>{compact(second)}"


def _magnitude_header(table: Table) -> str:
    """The header holds the feasible bounds, so that both numbers can be understood."""
    text = "\\|Q\\| over the largest feasible, overshoot"
    if table.feasible:
        text += f" (feasible Q: {compact(table.feasible[0])} to {compact(table.feasible[1])})"
    return text


def _minutes(row: Row) -> str:
    minutes = [run.record.wall_clock.total / 60 for run in row.finished]
    return number(sum(minutes) / len(minutes), 1) if minutes else NOTHING


def _parameters(row: Row) -> str:
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


def _csv_row(table: Table, row: Row) -> dict[str, object]:
    key, success, feasible = table.key, row.success, table.feasible
    statuses = [run.record.status for run in row.runs]
    sizes = row.runs[0].record.parameters if row.runs else None
    wall = [run.record.wall_clock.total for run in row.finished]
    return {
        "task": key.task,
        "embodiment": key.embodiment,
        "variant": key.variant,
        "base_policy": key.base,
        "group": key.group,
        "demonstration_mode": key.mode,
        "demonstrations": key.demonstrations,
        "env_steps": key.env_steps,
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
        **_ends("last_checkpoint", row.last),
        **_ends("against_base", row.difference),
        "best_reference": table.best_reference and table.best_reference.label,
        **_ends("against_best", row.against_best),
        **_ends("rise", row.rise),
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


def _ends(name: str, found: Interval | None) -> dict[str, object]:
    """A column each for a value and the ends of its interval."""
    ends = (found.value, found.low, found.high) if found else (None, None, None)
    return dict(zip((name, f"{name}_low", f"{name}_high"), ends, strict=True))
