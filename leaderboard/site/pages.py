"""What each page shows, as the values of its template; `run_page` has those of runs.

Addresses are relative to the site's folder; templates put `root` before them.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from symsteer.leaderboard.curve_figures import (
    audited_defects,
    equivariance_errors,
    learning_curves,
    q_values,
    success_by_direction,
)
from symsteer.leaderboard.defects import defect_of
from symsteer.leaderboard.figures import SHARE, by_rows, look_of
from symsteer.leaderboard.page import SECTIONS, by_title, figures_of, notices, seed_notice
from symsteer.leaderboard.plots import GREY, Axis, Dot, Figure, Look, cut
from symsteer.leaderboard.records import flat
from symsteer.leaderboard.rows import AgentRow, Table
from symsteer.leaderboard.runs import Run
from symsteer.leaderboard.sections import View
from symsteer.leaderboard.sections.cells import cell_tables, status
from symsteer.leaderboard.sections.success_in_every_cell import marks
from symsteer.leaderboard.site import markup
from symsteer.leaderboard.site.charts import Chart, charts
from symsteer.leaderboard.site.media import films_of_cell
from symsteer.leaderboard.site.results import Results, breaks, dials, strengths
from symsteer.leaderboard.statistics import Interval
from symsteer.leaderboard.text import NOTHING, compact, count, difference, interval, number

Values = dict[str, Any]

JSON = json.JSONEncoder(ensure_ascii=False)


@dataclass(frozen=True)
class Entry:
    """A cell of a table that sorts and filters.

    Attributes:
        href: where it leads.
        order: what it is sorted by; empty, and last, where there is no number; None for texts.
        facet: what it is filtered by, if that is not its text.
    """

    text: str
    href: str | None = None
    order: str | None = None
    facet: str | None = None


Line = dict[str, Entry]
"""A row of such a table, by the names of the columns."""


def measured(value: Any, write: Callable[[Any], str] = number) -> Entry:
    """A number, or an interval, sorted by all digits of its value."""
    middle = value.value if isinstance(value, Interval) else value
    return Entry(write(value), order="" if middle is None else repr(float(middle)))


def pages(results: Results) -> Iterator[tuple[str, str, Values]]:
    """Address, template and values of every page except those of runs."""
    yield "index.html", "index.html", overview(results)
    yield "findings.html", "findings.html", findings(results)
    yield "agents.html", "list.html", agents(results)
    yield "variants.html", "list.html", variants(results)
    yield "runs.html", "list.html", runs(results)
    tables = results.summary.tables
    for before, table, after in zip([None, *tables], tables, [*tables[1:], None], strict=False):
        values = {"before": _link(results, before), "after": _link(results, after)}
        yield results.cell(table.key), "cell.html", cell(results, table) | values
    for name in results.summary.agents:
        yield results.agent(name), "agent.html", agent(results, name)
    for name in results.dials:
        yield results.variant(name), "variant.html", variant(results, name)


def _link(results: Results, table: Table | None) -> tuple[str, str] | None:
    return (results.names[table.key], results.cell(table.key)) if table else None


def overview(results: Results) -> Values:
    """The first screen of the leaderboard's page, and the table of all cells and agents."""
    summary = results.summary
    records = [run.record for run in summary.runs]
    newest = max(record.ended or record.started for record in records)
    view, drawn = _view(results)
    first = by_title(view, [s for s in SECTIONS if s.where == "first"])
    link = {"PAPER.md": "findings.html#the-paper-s-claims"}.get
    # What was learned stands before what it was compared with.
    agents = sorted(summary.agents, key=lambda name: summary.roles[name] == "reference")
    return {
        "facts": {
            "runs": len(records),
            "cells": len(summary.tables),
            "agents": len(summary.agents),
            "hours of computing": number(sum(r.wall_clock.total for r in records) / 3600, 0),
            "newest run": f"{newest:%Y-%m-%d}",
        },
        "notice": _notice(results),
        "answer": [(anchor(t), t, markup.html(blocks, link, drawn)) for t, blocks in first],
        "agents": [(name, results.agent(name)) for name in agents],
        "matrix": [_matrix_row(results, table, agents) for table in summary.tables],
        "rows": [_result(results, table, row) for table, row in results.rows],
    }


def _view(results: Results) -> tuple[View, dict[str, list[Chart]]]:
    """How pages over all cells show sections, and the charts of the figures by address."""
    shown = figures_of(results.findings, [s for s in SECTIONS if s.where != "page"])
    figures = [(figure, str(index)) for index, figure in enumerate(shown)]
    links = {path: results.run(run) for path, run in results.runs.items()}
    return View(results.findings, links, figures), {at: charts(figure) for figure, at in figures}


def _notice(results: Results) -> str:
    """What a reader must know first, as HTML; its links lead to the web alone."""
    texts = [*notices(results.findings.study), seed_notice(results.summary)]
    web = ("https://", "http://")
    link = lambda href: href if href.startswith(web) else None  # noqa: E731
    return markup.html([text for text in texts if text], link) if any(texts) else ""


def _matrix_row(results: Results, table: Table, agents: Sequence[str]) -> Values:
    cells = []
    for name in agents:
        shown = []
        for row in (row for row in table.shown(name) if row.runs):
            value, _, ends = interval(row.success).partition("\u00a0")
            level = round(10 * row.success.value) if row.success else ""
            text = value + marks(row) if row.success else status(row)
            shown.append({"text": text, "ends": ends, "level": level})
        cells.append(shown)
    return {"name": results.names[table.key], "href": results.cell(table.key), "cells": cells}


def _place(task: str, embodiment: str, broken_by: Sequence[str], variant: str) -> Line:
    """Columns that say where something is measured; they come last, and are filtered by."""
    return {
        "Task": Entry(task),
        "Embodiment": Entry(embodiment),
        "Broken by": Entry(", ".join(broken_by)),
        "Strength": Entry(", ".join(strengths(variant)) or NOTHING),
    }


def _result(results: Results, table: Table, row: AgentRow) -> Line:
    """An agent in a cell, in the tables of the first page and of the agent's own."""
    key, defect = table.key, defect_of(table.key, results.audit)
    diverged = sum(row.diverged) / len(row.diverged) if row.diverged else None
    errors = [row.over_runs(f"equivariance_{part}") for part in ("actor", "critic")]
    error = max((value for value in errors if value is not None), default=None)
    return {
        "Cell": Entry(results.names[key], results.cell(key)),
        "Agent": Entry(row.label, results.agent(row.agent), facet=row.agent),
        "Success": measured(row.success, interval),
        "Rank": measured(row.rank, count),
        "Against base": measured(row.difference, difference),
        "Against best reference": measured(row.against_best, difference),
        "AUC": measured(row.area),
        "Q bias": measured(row.over_runs("q_bias", "q_bias_successful"), compact),
        "Q diverged": measured(diverged, _percent),
        "Equivariance error": measured(error, compact),
        "Defect": measured(defect and defect.interval, _percents),
        "Status": Entry(status(row)),
        **_place(key.task, key.embodiment, breaks(key), key.variant),
    }


def _percent(value: float | None) -> str:
    return NOTHING if value is None else f"{100 * value:.2g}\u202f%"


def _percents(measured: Interval | None) -> str:
    if measured is None:
        return NOTHING
    return f"{_percent(measured.value)} [{100 * measured.low:.2g}, {100 * measured.high:.2g}]"


def findings(results: Results) -> Values:
    """Every section of the leaderboard's page that the site has no other page for."""
    view, drawn = _view(results)
    shown = by_title(view, [s for s in SECTIONS if s.where in ("folded", "site")])
    link = {address: address for address in view.links.values()}.get
    sections = [(anchor(title), title, markup.html(blocks, link, drawn)) for title, blocks in shown]
    return {"notice": _notice(results), "sections": sections}


def anchor(title: str) -> str:
    """The address of a section within its page."""
    return re.sub(r"[^a-z]+", "-", title.lower()).strip("-")


def cell(results: Results, table: Table) -> Values:
    """One task, embodiment and variant: curves, Q, equivariance, all tables."""
    key = table.key
    links = {run.path: f"../{results.run(run)}" for run in table.runs}
    defect = defect_of(key, results.audit)
    shown = [learning_curves([table]), q_values([table])]
    shown += [equivariance_errors(table), success_by_direction(table)]
    return {
        "name": results.names[key],
        "key": key,
        "dials": [(name, results.variant(name)) for name in dials(key.variant)],
        "defect": f"{_percents(defect.interval)}, {defect.part}" if defect else "not audited",
        "budget": count(key.env_steps),
        "tables": markup.html(cell_tables(table, links), lambda href: href),
        "charts": dict(
            zip(("success", "q", "errors", "directions"), map(charts, shown), strict=True)
        ),
        "films": films_of_cell(table),
        "runs": results.runs_of(table),
        "picture": results.docs.picture("tasks", key.task),
    }


def agents(results: Results) -> Values:
    """The list of agents."""
    rows = [
        {
            "Agent": Entry(name, results.agent(name)),
            "Role": Entry(role),
            "Cells": measured(len({t.key for t, row in results.rows if row.agent == name}), str),
            "Runs": measured(sum(run.agent == name for run in results.summary.runs), str),
        }
        for name, role in results.summary.roles.items()
    ]
    lede = (
        "Learners are ranked, references are what they are compared with, controls explain a "
        "learner's result."
    )
    return {"title": "Agents", "lede": lede, "page": results.docs.page("agents.md"), "rows": rows}


def agent(results: Results, name: str) -> Values:
    """One agent: its standing over cells, its options."""
    rows = [(table, row) for table, row in results.rows if row.agent == name]
    usual = [row for _, row in rows if row.usual] or [row for _, row in rows]
    options = usual[0].runs[0].record.config.get("agent_options") if usual else None
    compared = {
        results.names[table.key]: (row, table.best_reference)
        for table, row in rows
        if row.success and row in table.shown(name)
    }
    return {
        "name": name,
        "role": results.summary.roles[name],
        "page": results.docs.page(f"agents/{name}.md", "agents.md"),
        "options": options_of(options if isinstance(options, Mapping) else {}),
        "charts": charts(standing(compared)) if compared else [],
        "rows": [_result(results, table, row) for table, row in rows],
    }


def standing(rows: Mapping[str, tuple[AgentRow, AgentRow | None]]) -> Figure:
    """Success of an agent in each cell, by its name, beside that of the best reference."""
    dots = []
    for index, (row, reference) in enumerate(rows.values()):
        best = Look(GREY, "D", "none", width=0.8, hollow=True)
        look = replace(look_of(row.agent, width=1.7), dash="none")
        if row.success:
            dots.append(Dot(cut(row.agent), row.success, index, look))
        if reference and reference.success:
            dots.append(Dot("best reference", reference.success, index + 0.2, best))
    labels, axis = [cut(name, 60) for name in rows], Axis("success in the final window", SHARE)
    return replace(by_rows(labels, {"": dots}, axis), text="Success in each cell")


def options_of(table: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Nested settings as names with dots and texts."""
    return [
        (key, value if isinstance(value, str) else JSON.encode(value))
        for key, value in flat(table).items()
    ]


def variants(results: Results) -> Values:
    """The list of variants."""
    rows = [
        {
            "Variant": Entry(name, results.variant(name)),
            "Audited tasks": measured(len({cell[:3] for cell in results.audited(name)}), str),
            "Cells with runs": measured(len(_cells_with(results, name)), str),
        }
        for name in results.dials
    ]
    lede = (
        "Ways to break the symmetry, each with a strength in [0, 1]. The audit measures in "
        "simulation how much a strength breaks."
    )
    address = results.docs.page("variants.md")
    return {"title": "Variants", "lede": lede, "page": address, "rows": rows}


def _cells_with(results: Results, name: str) -> list[Table]:
    return [t for t in results.summary.tables if name in dials(t.key.variant)]


def variant(results: Results, name: str) -> Values:
    """One way to break the symmetry: how much it breaks, and the cells that have it."""
    audited = results.audited(name)
    # The strongest first.
    maps = [one for one in results.maps if name in dials(one.variant)]
    maps.sort(key=lambda one: strengths(one.variant), reverse=True)
    return {
        "name": name,
        "page": results.docs.page("variants.md"),
        "picture": results.docs.picture("variants", name),
        "audit_page": results.docs.page("audit.md"),
        "charts": charts(audited_defects(audited)) if audited else [],
        "audited": [
            (*place, f"{strength:g}", _percents(defect.interval), defect.part)
            for *place, strength, defect in audited
        ],
        "maps": maps,
        "cells": [_link(results, table) for table in _cells_with(results, name)],
    }


def runs(results: Results) -> Values:
    """The table of all runs."""
    rows = [_run(results, run) for run in results.runs.values()]
    lede = (
        f"{len(rows)} runs. A run's page has its configuration, the command that repeats it, and "
        "every episode."
    )
    return {"title": "Runs", "lede": lede, "page": None, "rows": rows}


def _run(results: Results, run: Run) -> Line:
    record, settings, commit = run.record, run.record.settings, run.record.provenance.commit
    table, row = results.row_of.get(run.path) or (None, None)
    broken_by = breaks(table.key) if table else dials(settings.variant)
    page_of_agent = results.agent(run.agent) if run.agent in results.summary.roles else None
    return {
        "Run": Entry(results.names[table.key] if table else run.record.run_id, results.run(run)),
        "Agent": Entry(row.label if row else run.agent, page_of_agent, facet=run.agent),
        "Success": measured(run.success if run.finished else None),
        "Seed": measured(run.seed, str),
        "Last checkpoint": measured(record.final.success_once if record.final else None),
        "Status": Entry(record.status if row else "set aside"),
        "Steps": measured(record.budget.env_steps, count),
        "Minutes": measured(record.wall_clock.total / 60, "{:.1f}".format),
        "Started (UTC)": Entry(f"{record.started:%Y-%m-%d %H:%M}"),
        "Code": Entry(commit[:12] if commit else (record.provenance.version or NOTHING)),
        **_place(settings.task, settings.embodiment, broken_by, settings.variant),
    }
