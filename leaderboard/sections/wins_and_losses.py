"""Learners at a glance: in how many cells each is clearly above and below its rivals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from symsteer.leaderboard.known_agents import STANDARD
from symsteer.leaderboard.pairs import success_pairs
from symsteer.leaderboard.rows import MIN_SEEDS, Summary
from symsteer.leaderboard.sections import Section, View
from symsteer.leaderboard.statistics import Interval, crossed_bootstrap
from symsteer.leaderboard.text import MARKS, NOTHING, SPACE, code, share, table_text

EXPLAINED = f"""\
In how many cells a learner's final success is clearly above (\u25b2) and clearly below (\u25bc)
that of `{STANDARD}`, and that of the best reference, the frozen policy alone. The last column says
in how many of all its runs Q diverged."""


@dataclass(frozen=True)
class Tally:
    """In how many cells an agent's final success is clearly above and clearly below another's.

    Attributes:
        cells: those with the pairs of runs that a verdict needs.
    """

    above: int
    below: int
    cells: int


def against_references(summary: Summary) -> dict[str, Tally]:
    """Each learner against a cell's best reference; agents without such a cell are left out."""
    tallies = {}
    for agent in summary.agents:
        rows = [t.row_of(agent) for t in summary.tables if t.best_reference]
        enough = [row for row in rows if row and row.pairs_with_best >= MIN_SEEDS]
        tallies[agent] = _tally(row.against_best for row in enough)
    return {agent: tally for agent, tally in tallies.items() if tally.cells}


def against_standard(summary: Summary) -> dict[str, Tally]:
    """Each other learner against `STANDARD`; agents without a cell in common are left out."""
    tallies = {}
    for agent, role in summary.roles.items():
        if agent != STANDARD and role != "reference":
            rows = [(t.row_of(agent), t.row_of(STANDARD)) for t in summary.tables]
            cells = [success_pairs(row, other) for row, other in rows if row and other]
            enough = [list(pairs.values()) for pairs in cells if len(pairs) >= MIN_SEEDS]
            tallies[agent] = _tally(map(crossed_bootstrap, enough))
    return {agent: tally for agent, tally in tallies.items() if tally.cells}


def _tally(effects: Iterable[Interval | None]) -> Tally:
    signs = [effect.sign for effect in effects if effect]
    return Tally(signs.count(1), signs.count(-1), len(signs))


def render(rivals: Mapping[str, Mapping[str, Tally]], view: View) -> list[str]:
    """The table of learners, in the page's order; empty if no cell has enough pairs of runs."""
    if not any(rivals.values()):
        return []
    flags: dict[str, list[bool]] = {agent: [] for agent in view.summary.agents}
    for table in view.summary.tables:
        for row in table.trusted:
            flags[row.agent] += row.diverged
    rows = [
        {"Learner": code(agent)}
        | {name: _counts(tallies.get(agent)) for name, tallies in rivals.items()}
        | {"Q diverged": share(sum(diverged), len(diverged))}
        for agent, diverged in flags.items()
        if diverged
    ]
    return [EXPLAINED, table_text(rows, sparse=True)] if rows else []


def _counts(tally: Tally | None) -> str:
    if tally is None:
        return NOTHING
    return f"{tally.above}{MARKS[1]} {tally.below}{MARKS[-1]} of {tally.cells}".replace(" ", SPACE)


SECTION = Section(
    "At a glance",
    lambda findings: {
        f"Against {code(STANDARD)}": against_standard(findings.summary),
        "Against the best reference": against_references(findings.summary),
    },
    render,
)
