"""What each page shows, as the values of its template; `run_page` has those of runs."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from symsteer.leaderboard import page
from symsteer.leaderboard.answer import against_references
from symsteer.leaderboard.answer_page import gains_section
from symsteer.leaderboard.claims_page import CLAIMS, claims_section, paper_section
from symsteer.leaderboard.defects import MEASURES, defect_of
from symsteer.leaderboard.map_page import COLOUR, map_section
from symsteer.leaderboard.records import flat
from symsteer.leaderboard.site import charts, markup
from symsteer.leaderboard.site.board import Board, breaks, dials, strengths
from symsteer.leaderboard.site.clips import shared_media
from symsteer.leaderboard.statistics import Interval
from symsteer.leaderboard.summary import Row, Run, Table
from symsteer.leaderboard.tables import section, status
from symsteer.leaderboard.text import NOTHING, compact, count, difference, interval, number

Values = dict[str, Any]

STATUSES = ("finished", "running", "interrupted", "failed")

PERCENT = "\u202f%"


def pages(board: Board) -> Iterator[tuple[str, str, Values]]:
    """Address, template and values of every page except those of runs."""
    yield "index.html", "index.html", overview(board)
    yield "findings.html", "findings.html", findings(board)
    yield "agents.html", "agents.html", agents(board)
    yield "variants.html", "variants.html", variants(board)
    yield "runs.html", "runs.html", runs(board)
    tables = board.summary.tables
    for index, table in enumerate(tables):
        around = tables[index - 1] if index else None, (*tables[index + 1 :], None)[0]
        yield board.cell(table.key), "cell.html", cell(board, table, *around)
    for name in board.summary.agents:
        yield board.agent(name), "agent.html", agent(board, name)
    for name in board.dials:
        yield board.variant(name), "variant.html", variant(board, name)


def overview(board: Board) -> Values:
    """The answer at a glance, and the table of all cells and agents."""
    summary = board.summary
    found = charts.map_charts(board.findings.map, board.names)
    records = [run.record for run in summary.runs]
    days = [f"{moment:%Y-%m-%d}" for moment in sorted(r.ended or r.started for r in records)]
    embodiments = list(dict.fromkeys(embodiment for embodiment, _ in found))
    return {
        "facts": {
            "runs": len(records),
            "cells": len(summary.tables),
            "agents": len(summary.agents),
            "hours of computing": number(sum(r.wall_clock.total for r in records) / 3600, 0),
            "newest run": days[-1],
        },
        "notice": _notice(board),
        "verdicts": [
            {
                "agent": name,
                "href": board.agent(name),
                "above": tally.above,
                "below": tally.below,
                "open": tally.cells - tally.above - tally.below,
                "cells": tally.cells,
            }
            for name, tally in against_references(summary).items()
        ],
        "gains": markup.html(gains_section(board.findings)),
        "claims": Counter(outcome.verdict for outcome in board.findings.claims),
        "agents": [(name, board.agent(name)) for name in summary.agents],
        "matrix": [_matrix_row(board, table) for table in summary.tables],
        "map": {m: found[embodiments[0], m] for m in MEASURES} if embodiments else {},
        "map_of": embodiments[0] if embodiments else "",
        "rows": [_result(board, table, row) for table, row in board.rows],
        "filters": _filters([_facets(table, row) for table, row in board.rows]),
    }


def _notice(board: Board) -> str:
    """What a reader must know first, as HTML."""
    texts = [*page.notices(board.findings.study), page.seed_notice(board.summary)]
    return markup.html([text for text in texts if text], _web)


def _web(href: str) -> str | None:
    """Links of a study's notice: to the web alone."""
    return href if href.startswith(("https://", "http://")) else None


def _matrix_row(board: Board, table: Table) -> Values:
    cells = []
    for name in board.summary.agents:
        shown = []
        for row in page.at_a_glance(table, name):
            if row.success:
                value, ends = interval(row.success).split("\u00a0", 1)
                level, mark = round(10 * row.success.value), page.marks(row)
                shown.append({"value": value, "mark": mark, "ends": ends, "level": level})
            else:
                shown.append({"value": status(row), "mark": "", "ends": "", "level": ""})
        cells.append(shown)
    return {"name": board.names[table.key], "href": board.cell(table.key), "cells": cells}


def _facets(table: Table, row: Row) -> dict[str, list[str]]:
    """By what rows and runs are filtered."""
    found = [status for status in STATUSES if any(r.record.status == status for r in row.runs)]
    return {
        "Task": [table.key.task],
        "Embodiment": [table.key.embodiment],
        "Break": breaks(table.key),
        "Strength": strengths(table.key.variant) or [NOTHING],
        "Agent": [row.agent],
        "Status": found + ["missing"] * bool(row.missing),
    }


def _filters(rows: Sequence[Mapping[str, Sequence[str]]]) -> dict[str, list[str]]:
    """Values of each facet; a facet with one value needs no filter."""
    found: dict[str, list[str]] = {}
    for row in rows:
        for facet, values in row.items():
            known = found.setdefault(facet, [])
            known += [value for value in values if value not in known]
    return {facet: sorted(values) for facet, values in found.items() if len(values) > 1}


def _order(value: float | Interval | None) -> str:
    """What a column is sorted by: full numbers; none come last."""
    if isinstance(value, Interval):
        value = value.value
    return "" if value is None else repr(float(value))


def _result(board: Board, table: Table, row: Row) -> Values:
    """A row of the table of results: texts, and what they are sorted and filtered by."""
    key, found = table.key, defect_of(table.key, board.audit)
    defect = found.interval if found else None
    bias, error = row.over_runs("q_bias", "q_bias_successful"), _error(row)
    diverged = f"{sum(row.diverged)}/{len(row.diverged)}" if row.diverged else NOTHING
    share = sum(row.diverged) / len(row.diverged) if row.diverged else None
    return {
        "facets": _facets(table, row),
        "cell": board.cell(key),
        "name": board.names[key],
        "task": key.task,
        "embodiment": key.embodiment,
        "breaks": ", ".join(breaks(key)),
        "strength": ", ".join(strengths(key.variant)) or NOTHING,
        "agent": row.label,
        "agent_page": board.agent(row.agent),
        "numbers": [
            (interval(row.success), _order(row.success)),
            (difference(row.difference), _order(row.difference)),
            (number(row.area), _order(row.area)),
            (compact(bias), _order(bias)),
            (diverged, _order(share)),
            (compact(error), _order(error)),
            (_defect(defect) if defect else NOTHING, _order(defect)),
        ],
        "status": status(row),
    }


def _error(row: Row) -> float | None:
    """The larger equivariance error of actor and critics."""
    found = [row.over_runs(f"equivariance_{part}") for part in ("actor", "critic")]
    return max((value for value in found if value is not None), default=None)


def _defect(found: Interval) -> str:
    value, low, high = (f"{100 * v:.2g}" for v in (found.value, found.low, found.high))
    return f"{value}{PERCENT} [{low}, {high}]"


def findings(board: Board) -> Values:
    """Claims, soundness, the map, comparisons over all cells, provenance."""
    summary, found = board.summary, board.findings
    maps = charts.map_charts(found.map, board.names)
    by_embodiment: dict[str, list[charts.Chart]] = {}
    for (embodiment, _), chart in maps.items():
        by_embodiment.setdefault(embodiment, []).append(chart)
    explained, *blocks = map_section(summary, found, {})
    explained = explained.replace(COLOUR, "The text at a point says which.")
    spreads = page.spreads_section(summary, found.spreads) if found.spreads else []
    return {
        "notice": _notice(board),
        "reading": markup.html(page.reading(summary)),
        "claims": markup.html([CLAIMS, *claims_section(found)]),
        "sound": markup.html([page.SOUND, sound])
        if (sound := page.soundness_table(summary))
        else "",
        "paper": markup.html(paper_section(found)) if found.study.statements else "",
        "effects": markup.html(page.effects_section(summary)),
        "spreads": markup.html(spreads),
        "maps": by_embodiment,
        "map": markup.html([explained, *blocks]),
        "profiles": charts.profile_charts(found.comparisons),
        "profiles_text": page.PROFILES,
        "improvement_text": page.IMPROVEMENT,
        "improvement": markup.html(page.comparisons_section(found.comparisons, {})),
        "provenance": markup.html(page.provenance_facts(summary, found.audit)),
        "set_aside": [(run.record.run_id, board.run(run)) for run in summary.set_aside],
    }


def cell(board: Board, table: Table, before: Table | None, after: Table | None) -> Values:
    """One task, embodiment and variant: curves, Q, equivariance, all tables."""
    key = table.key
    links = {run.path: f"../{board.run(run)}" for run in table.runs}
    defect = defect_of(key, board.audit)
    picture = board.docs.task_picture(key.task) if board.docs.built else None
    return {
        "name": board.names[key],
        "key": key,
        "breaks": breaks(key),
        "dials": [(name, f"../{board.variant(name)}") for name in dials(key.variant)],
        "defect": f"{_defect(defect.interval)}, {defect.part}" if defect else "not audited",
        "budget": count(key.env_steps),
        "tables": markup.html(section(table, links), lambda href: href),
        "success": charts.success_chart(table),
        "q": charts.q_chart(table),
        "equivariance": charts.equivariance_chart(table),
        "directions": charts.direction_chart(table),
        "media": [(f"../{address}", kind, name) for address, kind, name, _ in shared_media(table)],
        "runs": [
            (row.label, [(run, f"../{board.run(run)}") for run in row.runs])
            for row in table.rows
            if row.runs
        ],
        "picture": picture and f"../docs/{picture[0]}",
        "task_page": picture and board.docs.page(picture[1], "../"),
        "before": before and (board.names[before.key], f"../{board.cell(before.key)}"),
        "after": after and (board.names[after.key], f"../{board.cell(after.key)}"),
    }


def agents(board: Board) -> Values:
    """The list of agents."""
    return {
        "agents": [
            {
                "name": name,
                "role": role,
                "href": board.agent(name),
                "facts": board.docs.agent(name, ""),
                "cells": sum(
                    any(row.agent == name and row.runs for row in t.rows)
                    for t in board.summary.tables
                ),
                "runs": sum(run.agent == name for run in board.summary.runs),
            }
            for name, role in board.summary.roles.items()
        ],
        "page": board.docs.page("agents.md", ""),
    }


def agent(board: Board, name: str) -> Values:
    """One agent: what it is, its options, its standing over cells."""
    rows = [(table, row) for table, row in board.rows if row.agent == name]
    usual = [row for _, row in rows if row.usual] or [row for _, row in rows]
    options = usual[0].runs[0].record.config.get("agent_options") if usual else None
    shown = [(t, row) for t, row in rows if row.success and row in page.at_a_glance(t, name)]
    return {
        "name": name,
        "role": board.summary.roles[name],
        "facts": board.docs.agent(name, "../"),
        "text": board.docs.agent_page(name, "../"),
        "page": board.docs.page("agents.md", "../"),
        "options": options_of(options if isinstance(options, Mapping) else {}),
        "chart": charts.standing_chart(
            [(board.names[table.key], row, table.best_reference) for table, row in shown]
        )
        if shown
        else None,
        "standing": [
            {
                "cell": board.names[table.key],
                "href": f"../{board.cell(table.key)}",
                "label": row.label,
                "numbers": [
                    (str(row.rank or NOTHING), _order(row.rank)),
                    (interval(row.success), _order(row.success)),
                    (difference(row.difference), _order(row.difference)),
                    (difference(row.against_best), _order(row.against_best)),
                    (number(row.area), _order(row.area)),
                ],
                "status": status(row),
            }
            for table, row in rows
        ],
        "many": len({row.label for _, row in rows}) > 1,
    }


def options_of(table: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Nested settings as names with dots and texts."""
    return [
        (key, value if isinstance(value, str) else json.dumps(value, ensure_ascii=False))
        for key, value in flat(table).items()
    ]


def variants(board: Board) -> Values:
    """The list of variants."""
    return {
        "variants": [
            {
                "name": name,
                "href": board.variant(name),
                "facts": board.docs.variant(name, ""),
                "cells": len(_cells_with(board, name)),
                "audited": len({cell[:3] for cell in board.audited(name)}),
            }
            for name in board.dials
        ],
        "page": board.docs.page("variants.md", ""),
    }


def _cells_with(board: Board, name: str) -> list[Table]:
    return [t for t in board.summary.tables if name in dials(t.key.variant)]


def variant(board: Board, name: str) -> Values:
    """One way to break the symmetry: what it does, how much, and the cells that have it."""
    audited = board.audited(name)
    maps = [found for found in board.maps if name in dials(found.variant)]
    picture = board.docs.variant_picture(name) if board.docs.built else None
    rising = sorted(maps, key=lambda found: strengths(found.variant))
    strongest = list({(found.task, found.embodiment): found for found in rising}.values())
    return {
        "name": name,
        "facts": board.docs.variant(name, "../"),
        "notes": board.docs.notes(name, "../"),
        "page": board.docs.page("variants.md", "../"),
        "picture": picture and f"../docs/{picture}",
        "audit_page": board.docs.page("audit.md", "../"),
        "chart": charts.audit_chart([cell[:5] for cell in audited]) if audited else None,
        "audited": [
            {
                "place": (task, embodiment, group),
                "strength": f"{strength:g}",
                "defect": (_defect(defect), _order(defect)),
                "part": part,
            }
            for task, embodiment, group, strength, defect, part in audited
        ],
        "maps": [(found, f"../{found.address}") for found in strongest],
        "more_maps": [(found, f"../{found.address}") for found in maps if found not in strongest],
        "cells": [
            (board.names[table.key], f"../{board.cell(table.key)}")
            for table in _cells_with(board, name)
        ],
    }


def runs(board: Board) -> Values:
    """The table of all runs."""
    rows = [_run(board, run) for run in board.runs]
    return {"rows": rows, "filters": _filters([row["facets"] for row in rows])}


def _run(board: Board, run: Run) -> Values:
    record = run.record
    settings = record.settings
    where = board.row_of.get(run.path)
    arm_and_dials = breaks(where[0].key) if where else dials(settings.variant)
    final = record.final.success_once if record.final else None
    success = run.success if run.finished else None
    minutes = record.wall_clock.total / 60
    commit = record.provenance.commit
    state = record.status if where else "set aside"
    facets = {
        "Task": [settings.task],
        "Embodiment": [settings.embodiment],
        "Break": arm_and_dials,
        "Strength": strengths(settings.variant) or [NOTHING],
        "Agent": [run.agent],
        "Status": [state],
    }
    return {
        "facets": facets,
        "href": board.run(run),
        "id": record.run_id,
        "short": record.run_id if len(record.run_id) < 15 else f"…{record.run_id[-12:]}",
        "task": settings.task,
        "embodiment": settings.embodiment,
        "breaks": ", ".join(arm_and_dials),
        "strength": ", ".join(strengths(settings.variant)) or NOTHING,
        "agent": where[1].label if where else run.agent,
        "agent_page": board.agent(run.agent) if run.agent in board.summary.roles else None,
        "numbers": [
            (str(run.seed), _order(run.seed)),
            (number(success), _order(success)),
            (number(final), _order(final)),
            (count(record.budget.env_steps), _order(record.budget.env_steps)),
            (number(minutes, 1), _order(minutes)),
        ],
        "status": state,
        "started": f"{record.started:%Y-%m-%d %H:%M}",
        "commit": commit[:12] if commit else (record.provenance.version or NOTHING),
    }
