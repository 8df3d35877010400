"""Suites as plain data: TOML files with grids of runs. Light to import.

``[grid]`` lists values for keys of a run's configuration; nested keys have a dot
(``"demonstrations.count"``). The runs are the product of the lists, in the order of the file.
``strength`` lists strengths for the variants without one. If there are several
grids, each is a ``[[grid]]``. ``[run]`` sets values for all runs, nested like the
configuration. ``symsteer.bench.sweep.suite`` describes the options of agents and policies.
"""

from __future__ import annotations

import copy
import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from symsteer.errors import UserError
from symsteer.files import read_toml
from symsteer.names import check
from symsteer.variant import with_strength

SUITES = Path(__file__).parent.parent / "suites"

LARGEST_GRID = 100_000

NAMED = ("agent", "policy")
"""Keys that hold a name (``agent = "base"``) or a table with ``name`` and options."""


@dataclass(frozen=True)
class Grid:
    """A grid of runs.

    Attributes:
        keys: whose values it lists.
        runs: a table for each run: nested plain data, shared settings included.
    """

    keys: tuple[str, ...]
    runs: tuple[dict[str, Any], ...]


@dataclass(frozen=True)
class SuiteData:
    """A suite as its file describes it.

    Attributes:
        name: of the file, without its ending.
        source: file name; messages begin with it.
        description: what the suite is for.
        shared: settings of all runs; ``agent`` and ``policy`` are tables.
        grids: in the order of the file.
    """

    name: str
    source: str
    description: str
    shared: dict[str, Any]
    grids: tuple[Grid, ...]

    @property
    def runs(self) -> list[dict[str, Any]]:
        """The tables of all runs, each once."""
        return list({repr(run): run for grid in self.grids for run in grid.runs}.values())


def suite_names() -> list[str]:
    """The suites that come with SymSteer."""
    return sorted(path.stem for path in SUITES.glob("*.toml"))


def read_suite(name_or_path: str) -> SuiteData:
    """Read a suite by name or from a TOML file.

    Raises:
        UserError: if there is no such suite, or the file is not a suite.
    """
    return suite_data(*read_toml(name_or_path, "suite", SUITES))


def suite_data(data: dict[str, Any], path: Path) -> SuiteData:
    """A suite from the content of its file.

    Args:
        data: the tables of the file.
        path: of the file, which gives the suite its name; messages begin with the file's name.

    Raises:
        UserError: if the content is not a suite.
    """
    source = path.name
    check("key", data, ("description", "grid", "run"), source)
    shared, description = data.get("run", {}), data.get("description", "")
    if not isinstance(shared, dict):
        raise UserError(f"{source}: run must be a table, [run]")
    if not isinstance(description, str):
        raise UserError(f"{source}: description must be a text in quotes")
    shared = _with_tables(shared, source)
    grids = data.get("grid", {})
    grids = grids if isinstance(grids, list) else [grids]
    if not all(isinstance(grid, dict) for grid in grids):
        raise UserError(f"{source}: grid must be a table, [grid], or several, each [[grid]]")
    found = (
        Grid(tuple(grid), tuple(_merge(shared, cell, source) for cell in _cells(grid, source)))
        for grid in grids
    )
    return SuiteData(path.stem, source, description, shared, tuple(found))


def split_key(key: str) -> list[str]:
    """The path of a grid's key in nested tables: ``"evaluation.every"`` is evaluation, every.

    The name of an agent or policy may contain dots: ``"agent.package.module:Class.width"`` is
    agent, package.module:Class, width.
    """
    kind, _, rest = key.partition(".")
    if key in NAMED:
        return [key, "name"]
    if kind not in NAMED:
        return key.split(".")
    name, _, option = rest.rpartition(".")
    return [kind, name, option] if name else [kind, option]


def _cells(grid: dict[str, Any], source: str) -> Iterator[dict[str, Any]]:
    """Every combination of a grid's values, strengths joined to their variants."""
    for key, values in grid.items():
        if not isinstance(values, list) or not values:
            raise UserError(f"{source}: grid.{key} must be a list with at least one value")
    if (count := math.prod(map(len, grid.values()))) > LARGEST_GRID:
        raise UserError(
            f"{source}: a grid has {count} runs; it must not have more than {LARGEST_GRID}, so "
            "shorten its lists"
        )
    for chosen in itertools.product(*grid.values()):
        cell = dict(zip(grid, chosen, strict=True))
        if "strength" in cell:
            cell["variant"] = _with_strength(cell.get("variant"), cell.pop("strength"), source)
        yield cell


def _with_strength(variant: Any, strength: Any, source: str) -> str:
    if not isinstance(variant, str):
        raise UserError(f"{source}: grid.strength needs grid.variant, a list of names")
    if isinstance(strength, bool) or not isinstance(strength, int | float):
        raise UserError(f"{source}: grid.strength must list numbers in [0, 1], not {strength!r}")
    return with_strength(variant, strength)


def _with_tables(shared: dict[str, Any], source: str) -> dict[str, Any]:
    """The shared settings, with ``agent = NAME`` written as a table."""
    shared = dict(shared)
    for key in NAMED:
        value = shared.setdefault(key, {})
        if isinstance(value, str):
            shared[key] = {"name": value}
        elif not isinstance(value, dict):
            raise UserError(f"{source}: run.{key} must be a name or a table, not {value!r}")
    return shared


def _merge(shared: dict[str, Any], cell: dict[str, Any], source: str) -> dict[str, Any]:
    """The shared settings, replaced by a cell's values."""
    merged = copy.deepcopy(shared)
    for key, value in cell.items():
        place = merged
        *path, last = split_key(key)
        for part in path:
            place = place.setdefault(part, {})
            if not isinstance(place, dict):
                raise UserError(f"{source}: run.{part} must be a table, so that {key} has a place")
        place[last] = value
    return merged
