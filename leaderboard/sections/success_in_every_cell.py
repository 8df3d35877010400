"""Success of every agent in every cell, in one table."""

from __future__ import annotations

from symsteer.leaderboard.cell_names import cell_name
from symsteer.leaderboard.rows import AgentRow, Summary
from symsteer.leaderboard.sections import Section, View
from symsteer.leaderboard.sections.cells import status
from symsteer.leaderboard.text import NOTHING, SPACE, code, mark_of, number, table_text


def render(summary: Summary, view: View) -> list[str]:
    """A row for each cell, a column for each agent."""
    rows = [
        {"Cell": cell_name(table, summary)}
        | {
            code(agent): "<br>".join(map(_shown, table.shown(agent))) or NOTHING
            for agent in summary.agents
        }
        for table in summary.tables
    ]
    return [table_text(rows)]


def _shown(row: AgentRow) -> str:
    if row.success is None:
        return status(row) if row.runs else NOTHING
    return f"{number(row.success.value)}{marks(row)}".replace(" ", SPACE)


def marks(row: AgentRow) -> str:
    """Beside its success: a clear difference from the base, no reproduction, diverged Q."""
    return mark_of(row.difference) + " not reproduced" * row.marked + " \u2020" * any(row.diverged)


SECTION = Section("Success in every cell", lambda findings: findings.summary, render, where="page")
