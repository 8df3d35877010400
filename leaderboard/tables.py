"""The page: LEADERBOARD.md and leaderboard.csv from a summary.

Text that comes from a record is only ever shown inside code spans, stripped of what could end one
(`code`), so that no record can inject markup, and is never used as a path or a link.
"""

from __future__ import annotations

import csv
import io
import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from urllib.parse import quote

from leaderboard.records import DIVERGED_EVALUATIONS, DIVERGED_SHARE
from leaderboard.statistics import Interval
from leaderboard.summary import ARM, MIN_SEEDS, THRESHOLD, Key, Row, Run, Summary, Table

NOTHING = "\u2013"
MINUS = "\u2212"
MARKS = {1: " \u25b2", 0: "", -1: " \u25bc"}

READING = f"""\
Each agent steers a frozen diffusion policy by choosing the noise that it starts from. `base` draws
that noise at random and `zero` sets it to 0: they do not learn, and every other row should beat
them. All agents of a table share the task, the demonstrations, the budget and the held-out episodes
that score them; the number is always the last checkpoint's, never the best one's.

- **Success** is `success_once` over the held-out episodes: the interquartile mean (IQM) over seeds
  and its 95 % interval, from a bootstrap over seeds and over the episodes of each. With fewer than
  4 seeds the IQM is the plain mean; with one seed the interval covers its episodes only.
- **Against base** is the mean difference to the base policy on the same episodes and seeds, with
  its 95 % interval. ▲ or ▼ marks an interval that excludes 0; without a mark, the data do not
  decide.
- **AUC** is the area under the success curve as a share of the budget: how good the agent was on
  average while it learned. **Steps** is the median number of environment steps until the success
  reaches {100 * THRESHOLD:.0f} % of the best learning agent's final one, and how many seeds got
  there. **Dip** is the deepest fall below the base policy at any evaluation of any seed.
- **Diverged** († at a glance) counts the seeds whose Q-values left the range of returns that the
  reward allows (more than {100 * DIVERGED_SHARE:.0f} % of the states at {DIVERGED_EVALUATIONS}
  evaluations in a row, once learning has begun) or were not finite.
- Statistics use finished runs. Failed, interrupted, running and missing ones are counted under
  **Runs** and never dropped in silence.
"""

CAPTION = (
    "Thick lines are the IQM (success) or the mean (Q) over seeds, bands the 95 % interval of the "
    "IQM, thin lines single seeds, dotted ones with a cross unfinished runs. The green area holds "
    "the returns that the reward allows."
)


def code(text: str, limit: int = 300) -> str:
    """Show text from a record as a code span that it cannot leave, on one line, in a table cell."""
    allowed = "".join(c if c.isprintable() else " " for c in text)
    for bad, good in (("`", "'"), ("|", "¦"), ("\\", "/")):
        allowed = allowed.replace(bad, good)
    allowed = " ".join(allowed.split())
    if len(allowed) > limit:
        allowed = allowed[: limit - 1] + "…"
    return f"`{allowed}`" if allowed else NOTHING


def number(value: float | None, digits: int = 2, sign: bool = False) -> str:
    """A number for reading: fixed digits, a true minus sign, a dash where there is none."""
    if value is None:
        return NOTHING
    text = f"{value:+.{digits}f}" if sign else f"{value:.{digits}f}"
    if float(text) == 0:
        text = f"{0:.{digits}f}"
    return text.replace("-", MINUS)


def compact(value: float | None) -> str:
    """Two or three significant digits for quantities of any size, such as Q-values and errors."""
    if value is None:
        return NOTHING
    if value == 0:
        text = "0"
    elif 1e3 <= abs(value) < 1e5:
        text = f"{value:.0f}"
    elif 1e-3 <= abs(value) < 1e3:
        text = f"{value:.3g}"
    else:
        mantissa, exponent = f"{value:.1e}".split("e")
        text = f"{mantissa}e{int(exponent)}"
    return text.replace("-", MINUS)


def count(value: float | None) -> str:
    """A count in thousands or millions."""
    if value is None:
        return NOTHING
    for unit, size in (("M", 1e6), ("k", 1e3)):
        if value >= size:
            return f"{value / size:.3g} {unit}".replace(" ", "\u00a0")
    return f"{value:.0f}"


def interval(value: Interval | None, sign: bool = False) -> str:
    """`0.71 [0.66, 0.77]` on one line."""
    if value is None:
        return NOTHING
    low, high = number(value.low, sign=sign), number(value.high, sign=sign)
    return f"{number(value.value, sign=sign)} [{low}, {high}]".replace(" ", "\u00a0")


def render_page(
    summary: Summary,
    figures: Mapping[tuple[str, str], Sequence[tuple[str, str]]],
    links: Mapping[Path, str | None],
) -> str:
    """The markdown page.

    `figures[task, embodiment]` lists (description, relative path); `links[path of a record]` is
    its address relative to the page, None to show none.
    """
    parts = [
        "# Leaderboard",
        "This page is generated from run records by `symsteer report`; do not edit it.",
        "## How to read it",
        READING.strip(),
    ]
    if notice := _seed_notice(summary):
        parts.append(notice)
    parts += ["## At a glance", _overview(summary)]
    place = None
    for table in summary.tables:
        key = table.key
        if (key.task, key.embodiment) != place:
            place = key.task, key.embodiment
            parts.append(f"## {code(key.task)}, {code(key.embodiment)}")
            if place in figures:
                parts += [f"![{text}]({quote(path)})" for text, path in figures[place]]
                parts.append(CAPTION)
        parts += _section(table)
    parts += ["## Provenance", *_provenance(summary, links)]
    return "\n\n".join(parts) + "\n"


def _seed_notice(summary: Summary) -> str:
    learning = [row for table in summary.tables for row in table.rows if not row.is_reference]
    few = [row for row in learning if len(row.finished) < MIN_SEEDS]
    if not few:
        return ""
    which = "No agent here has" if len(few) == len(learning) else "Not every agent here has"
    return (
        f"> **Not ranked.** {which} the {MIN_SEEDS} finished seeds that a ranking needs. Agents "
        "with fewer are shown in a fixed order; read the intervals, and treat differences between "
        "agents as leads, not as results."
    )


def _overview(summary: Summary) -> str:
    header = ["Task", *(code(agent) for agent in summary.agents)]
    rows = []
    for table in summary.tables:
        cells = []
        for agent in summary.agents:
            rows_of = [row for row in table.rows if row.agent == agent]
            cells.append("<br>".join(_glance(row) for row in rows_of) or NOTHING)
        rows.append([_cell_name(table, summary), *cells])
    return _grid(header, rows, left=1)


def _glance(row: Row) -> str:
    if row.success is None:
        return _status(row)
    mark = MARKS[row.difference.sign] if row.difference else ""
    dagger = " \u2020" if any(row.diverged) else ""
    value, bounds = interval(row.success).split("\u00a0", 1)
    return f"{value}{mark}{dagger}".replace(" ", "\u00a0") + f"<br>{bounds}"


def _broken_by(key: Key) -> str:
    return " and ".join(part if part == ARM else code(part) for part in key.broken_by)


def _cell_name(table: Table, summary: Summary) -> str:
    """Task, embodiment and variant, and of the rest of the key what tells the tables apart."""
    key = table.key
    name = f"{code(key.task)} {code(key.embodiment)} {_broken_by(key) or 'unbroken'}"
    keys = [other.key for other in summary.tables]
    if len({other.base + other.group for other in keys}) > 1:
        name += f" {code((key.base + ' ' + key.group).strip())}"
    if len({(other.mode, other.demonstrations) for other in keys}) > 1:
        name += f" {code(f'{key.demonstrations} {key.mode}')}"
    if len({other.env_steps for other in keys}) > 1:
        name += f" {count(key.env_steps)}"
    return name


def _section(table: Table) -> list[str]:
    key = table.key
    broken = _broken_by(key)
    heading = f"Broken by {broken}" if broken else "Unbroken symmetry"
    parts = [f"### {heading}", _base_line(table)]
    header = ["Agent", "Success (IQM)", "Against base", "AUC", "Steps", "Dip", "Episodes", "Runs"]
    if table.is_ranked:
        header.insert(0, "Rank")
    rows = []
    for row in table.rows:
        cells = [
            code(row.label),
            interval(row.success),
            interval(row.difference, sign=True)
            + (MARKS[row.difference.sign] if row.difference else ""),
            number(row.area),
            _steps(row, key.env_steps),
            number(row.dip),
            _episodes(row),
            _status(row),
        ]
        rows.append([str(row.rank or NOTHING), *cells] if table.is_ranked else cells)
    parts.append(_grid(header, rows, left=2 if table.is_ranked else 1))
    parts += _diagnostics(table)
    if notes := _notes(table):
        parts.append("\n".join(f"- {note}" for note in notes))
    return parts


def _base_line(table: Table) -> str:
    key = table.key
    policies = {run.record.base_policy.content_hash: run.record.base_policy for run in table.runs}
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
    if table.threshold is not None:
        text.append(f"Steps count to a success of {number(table.threshold)}.")
    return " ".join(text)


def _steps(row: Row, budget: int) -> str:
    if not row.threshold_steps:
        return NOTHING
    reached = sum(steps is not None for steps in row.threshold_steps)
    median = row.median_threshold_steps
    text = f"> {count(budget)}" if median is None else count(median)
    return f"{text} ({reached}/{len(row.threshold_steps)})".replace(" ", "\u00a0")


def _episodes(row: Row) -> str:
    counts = row.episodes
    if not counts:
        return NOTHING
    size = str(counts[0]) if len(set(counts)) == 1 else f"{min(counts)} to {max(counts)}"
    return f"{len(counts)} \u00d7 {size}".replace(" ", "\u00a0")


def _status(row: Row) -> str:
    parts = []
    for status in ("finished", "running", "interrupted", "failed"):
        if number_of := sum(run.record.status == status for run in row.runs):
            parts.append(f"{number_of} {status}")
    if row.missing:
        parts.append(f"{row.missing} missing")
    return ", ".join(parts).replace(" ", "\u00a0").replace(",\u00a0", ", ")


def _diagnostics(table: Table) -> list[str]:
    rows = [row for row in table.rows if row.runs and not row.is_reference]
    if not rows:
        return []
    feasible = table.feasible
    bounds = f" (feasible Q: {compact(feasible[0])} to {compact(feasible[1])})" if feasible else ""
    header = [
        "Agent",
        "Diverged",
        "Largest \\|Q\\|",
        "Q bias",
        "Orbit variance",
        "Equivariance error: actor, critic",
        "Parameters: actor, critic (width)",
        "Minutes a run",
    ]
    body = []
    for row in rows:
        diverged = row.diverged
        errors = [row.over_runs("equivariance_actor"), row.over_runs("equivariance_critic")]
        minutes = [run.record.wall_clock.total / 60 for run in row.finished]
        body.append(
            [
                code(row.label),
                f"{sum(diverged)}/{len(diverged)}" if diverged else NOTHING,
                compact(row.largest("q_abs_max")),
                compact(row.over_runs("q_bias")),
                compact(row.over_runs("orbit_variance")),
                ", ".join(map(compact, errors)) if any(e is not None for e in errors) else NOTHING,
                _parameters(row),
                number(sum(minutes) / len(minutes), 1) if minutes else NOTHING,
            ]
        )
    return [f"Q-values, symmetry and cost{bounds}:", _grid(header, body, left=1)]


def _parameters(row: Row) -> str:
    sizes = {
        (p.actor, p.critic, p.width) for run in row.runs if (p := run.record.parameters).total > 0
    }
    if not sizes:
        return NOTHING
    texts = []
    for actor, critic, width in sorted(sizes, key=str):
        text = f"{count(actor)}, {count(critic)}" + (f" ({width})" if width else "")
        texts.append(text.replace(" ", "\u00a0"))
    return "; ".join(texts)


def _notes(table: Table) -> list[str]:
    notes = []
    warnings = {run.record.base_policy.warning for run in table.runs} - {None, ""}
    notes += [f"Base policy: {code(str(warning))}" for warning in sorted(map(str, warnings))]
    for row in table.rows:
        for run in row.runs:
            record = run.record
            if record.status == "finished":
                continue
            done = record.evaluations[-1].env_steps if record.evaluations else 0
            why = f": {code(record.failure)}" if record.failure else ""
            notes.append(
                f"{code(row.label)}, seed {run.seed}: {record.status}, "
                f"last evaluated after {count(done)} steps{why}"
            )
        if row.runs and row.agent != "base" and row.finished and row.difference is None:
            notes.append(f"{code(row.label)}: no base run on the same episodes to compare with")
    if any(row.label != row.agent for row in table.rows):
        split = ", ".join(code(row.label) for row in table.rows if row.label != row.agent)
        notes.append(f"Same agent with different settings, in rows of their own: {split}")
    return notes


def _provenance(summary: Summary, links: Mapping[Path, str | None]) -> list[str]:
    runs = summary.runs
    records = [run.record for run in runs]
    started = min(record.started for record in records)
    ended = max(record.ended or record.started for record in records)
    hours = sum(record.wall_clock.total for record in records) / 3600
    parts = [
        "Regenerate with `symsteer report`, or `python -m leaderboard RECORDS --out FOLDER`: the "
        "same records give the same bytes. Each record holds the whole configuration and every "
        "evaluation episode with its seed.",
        "\n".join(
            [
                f"- Runs: {len(records)}, {number(hours, 1)} hours in all, "
                f"{started:%Y-%m-%d} to {ended:%Y-%m-%d} (UTC)",
                f"- Commits: {_values(_commit(run) for run in runs)}",
                f"- Devices: {_values(r.provenance.device for r in records)}; platforms: "
                f"{_values(r.provenance.platform for r in records)}; Python: "
                f"{_values(r.provenance.python for r in records)}; torch threads: "
                f"{_values(str(r.provenance.torch_threads) for r in records)}",
                "- Packages: "
                + _values(
                    f"{name} {version}"
                    for record in records
                    for name, version in record.provenance.packages.items()
                ),
            ]
        ),
    ]
    rows = []
    for table in summary.tables:
        for row in table.rows:
            for run in row.runs:
                rows.append(
                    [
                        _cell_name(table, summary),
                        code(row.label),
                        str(run.seed),
                        run.record.status,
                        _commit_cell(run),
                        code(run.record.config_hash[:12]),
                        _link(run, links),
                    ]
                )
    header = ["Task", "Agent", "Seed", "Status", "Commit", "Config", "Record"]
    grid = _grid(header, rows, left=2)
    parts.append(f"<details>\n<summary>All records</summary>\n\n{grid}\n\n</details>")
    if summary.set_aside:
        aside = ", ".join(_link(run, links) for run in summary.set_aside)
        parts.append(
            "Set aside, because a finished or newer record of the same configuration and seed "
            f"exists: {aside}."
        )
    return parts


def _commit(run: Run) -> str:
    provenance = run.record.provenance
    if provenance.commit is None:
        return "outside git"
    return provenance.commit[:12] + (" with local changes" if provenance.dirty else "")


def _commit_cell(run: Run) -> str:
    provenance = run.record.provenance
    if provenance.commit is None:
        return NOTHING
    return code(provenance.commit[:12] + ("+" if provenance.dirty else ""))


def _values(texts: Iterable[str]) -> str:
    return ", ".join(code(text) for text in sorted(set(texts))) or NOTHING


def _link(run: Run, links: Mapping[Path, str | None]) -> str:
    # run_id is validated to letters, digits and ._+=:,@- so that it is safe as a link's text.
    target = links.get(run.path)
    name = code(run.record.run_id)
    return f"[{name}]({target})" if target else name


def relative_link(path: Path, folder: Path) -> str | None:
    """URL of `path` relative to `folder`; None where it would spell out folders of this machine."""
    relative = Path(os.path.relpath(path, folder))
    if relative.is_absolute() or relative.parts[:3] == ("..", "..", ".."):
        return None
    return quote(relative.as_posix())


def _grid(header: Sequence[str], rows: Sequence[Sequence[str]], left: int) -> str:
    """A markdown table; the first `left` columns are left-aligned, the others right-aligned."""
    rule = [":--" if index < left else "--:" for index in range(len(header))]
    return "\n".join("| " + " | ".join(row) + " |" for row in (header, rule, *rows))


CSV_DIAGNOSTICS = (
    "q_mean",
    "q_violation",
    "q_bias",
    "q_bias_std",
    "orbit_variance",
    "alpha",
    "entropy",
    "equivariance_decode",
    "equivariance_actor",
    "equivariance_critic",
)


def render_csv(summary: Summary) -> str:
    """One line a row of the tables, full precision (6 significant digits), empty where unknown."""
    rows = [_csv_row(table, row) for table in summary.tables for row in table.rows]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(rows[0])
    writer.writerows([_csv_cell(value) for value in row.values()] for row in rows)
    return out.getvalue()


def _csv_row(table: Table, row: Row) -> dict[str, object]:
    key, success, difference = table.key, row.success, row.difference
    statuses = [run.record.status for run in row.runs]
    sizes = row.runs[0].record.parameters if row.runs else None
    wall = [run.record.wall_clock.total for run in row.finished]
    feasible = table.feasible
    return {
        "task": key.task,
        "embodiment": key.embodiment,
        "variant": key.variant,
        "base_policy": key.base,
        "group": key.group,
        "demonstration_mode": key.mode,
        "demonstrations": key.demonstrations,
        "env_steps": key.env_steps,
        "agent": row.agent,
        "recipe": row.recipe[:12],
        "rank": row.rank,
        "runs": len(row.runs),
        **{s: statuses.count(s) for s in ("finished", "failed", "interrupted", "running")},
        "missing": row.missing,
        "episodes": sum(row.episodes),
        "success_iqm": success and success.value,
        "success_low": success and success.low,
        "success_high": success and success.high,
        "final_window": row.window,
        "difference": difference and difference.value,
        "difference_low": difference and difference.low,
        "difference_high": difference and difference.high,
        "auc": row.area,
        "threshold": table.threshold,
        "threshold_steps": row.median_threshold_steps,
        "threshold_seeds": sum(s is not None for s in row.threshold_steps),
        "dip": row.dip,
        "diverged": sum(row.diverged),
        "with_critic": len(row.diverged),
        "q_abs_max": row.largest("q_abs_max"),
        "feasible_low": feasible and feasible[0],
        "feasible_high": feasible and feasible[1],
        **{name: row.over_runs(name) for name in CSV_DIAGNOSTICS},
        "parameters_actor": sizes and sizes.actor,
        "parameters_critic": sizes and sizes.critic,
        "width": sizes and sizes.width,
        "wall_clock_s": sum(wall) / len(wall) if wall else None,
    }


def _csv_cell(value: object) -> str:
    if value is None:
        return ""
    if isinstance(value, float):
        return f"{value:.6g}"
    text = str(value)
    # A spreadsheet would run a text that starts like a formula.
    return f"'{text}" if isinstance(value, str) and text[:1] in ("=", "+", "-", "@") else text
