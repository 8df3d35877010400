"""The runs that a name means: those of a path, or those of an agent or a commit among records."""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from symsteer.errors import UserError
from symsteer.leaderboard.grouping import grouped
from symsteer.leaderboard.keys import Key, grid_of
from symsteer.leaderboard.rows import AgentRow
from symsteer.leaderboard.runs import Run, load_runs
from symsteer.names import unknown

Kind = Literal["folder", "file", "agent", "commit"]

COMMIT = re.compile(r"[0-9a-f]{4,64}")
"""The beginning of a commit, or of the hash of an installed package; git asks for 4 digits, too."""


@dataclass(frozen=True)
class Leftover:
    """A run that is not compared, and why."""

    run: Run
    reason: str


@dataclass(frozen=True)
class Side:
    """A or B.

    Attributes:
        name: as it was given.
        kind: how it was read.
        place: the file or folder with the records.
        rows: finished runs, by cell, agent and settings; of equal runs the newest.
        leftovers: its other runs.
    """

    name: str
    kind: Kind
    place: Path
    rows: tuple[tuple[Key, AgentRow], ...]
    leftovers: tuple[Leftover, ...]

    @property
    def runs(self) -> list[Run]:
        return [run for _, row in self.rows for run in row.finished]


def read_sides(a: str, b: str, place: Path) -> tuple[Side, Side]:
    """The runs that two names mean.

    A path that exists comes first, then an agent, then the beginning of a commit.

    Args:
        a: the first name.
        b: the second name.
        place: record file or folder with the records of agents and commits.

    Raises:
        UserError: for a name that means nothing or several commits, records that cannot be read,
            no finished run, or a record that belongs to both.
    """
    load = functools.cache(lambda: load_runs([place]))
    first, second = (_side(name, place, load) for name in (a, b))
    both = {run.path for run in first.runs} & {run.path for run in second.runs}
    if both:
        raise UserError(
            f"{len(both)} of the runs belong to A ({a}) and to B ({b}), such as {min(both)}; name "
            "two sets without a common run"
        )
    return first, second


def code_of(run: Run) -> str:
    """The commit with which a run began; of an installed package, the hash of its code."""
    provenance = run.record.provenance
    return provenance.commit or provenance.sha256 or ""


def _side(name: str, place: Path, load: Callable[[], list[Run]]) -> Side:
    """A side; of an agent's runs alone no grid of options can be seen."""
    kind, runs, grid = _meant(name, place, load)
    tables, older = grouped(runs, grid)
    leftovers = [Leftover(run, "a newer record of the same run") for run in older]
    rows = []
    for table in tables:
        for row in table.rows:
            if kind == "agent" and row is not table.row_of(name):
                leftovers += [Leftover(run, f"other settings: {row.label}") for run in row.runs]
                continue
            unfinished = [run for run in row.runs if not run.finished]
            leftovers += [Leftover(r, f"not finished: {r.record.status}") for r in unfinished]
            if row.finished:
                rows.append((table.key, row))
    if not rows:
        raise UserError(
            f"{name} has no finished run among {len(runs)} records; finish one, for example with "
            "`symsteer resume`"
        )
    place = Path(name) if kind in ("folder", "file") else place
    return Side(name, kind, place, tuple(rows), tuple(leftovers))


def _meant(
    name: str, place: Path, load: Callable[[], list[Run]]
) -> tuple[Kind, list[Run], Sequence[str] | None]:
    """How a name is read, the runs that it means, and the options of their grid if known."""
    if os.path.exists(name):
        return "folder" if os.path.isdir(name) else "file", load_runs([Path(name)]), None
    if not place.exists():
        raise UserError(
            f"{name!r} is no file or folder, and there is no folder {place} with records of an "
            "agent or a commit of this name; name a folder of runs, or one to look in with --runs"
        )
    pool = load()
    agents = sorted({run.agent for run in pool})
    if name in agents:
        return (
            "agent",
            [run for run in pool if run.agent == name],
            grid_of(run.record for run in pool),
        )
    codes = sorted({code_of(run) for run in pool} - {""})
    prefix = name.lower()
    begun = [code for code in codes if COMMIT.fullmatch(prefix) and code.startswith(prefix)]
    if len(begun) > 1:
        raise UserError(
            f"{len(begun)} commits in {place} begin with {name}: "
            f"{', '.join(code[:12] for code in begun)}; give more digits"
        )
    if not begun:
        valid = [*agents, *(code[:8] for code in codes)]
        raise unknown("folder, agent or commit", name, valid, str(place))
    return "commit", [run for run in pool if code_of(run) == begun[0]], None
