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
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, PrivateAttr, model_validator

from symsteer.files import read_model
from symsteer.variant import with_strength

SUITES = Path(__file__).parent.parent / "suites"

LARGEST_GRID = 100_000

NAMED = ("agent", "policy")
"""Keys that hold a name (``agent = "base"``) or a table with ``name`` and options."""

Table = dict[str, Any]

Grid = dict[str, Annotated[list[Any], Field(min_length=1)]]
"""Values by key."""

Grids = Annotated[list[Grid], BeforeValidator(lambda one: [one] if isinstance(one, dict) else one)]


class SuiteFile(BaseModel):
    """A suite as its file describes it."""

    model_config = ConfigDict(extra="forbid")

    description: str = ""
    grid: Grids = [{}]
    run: Table = {}
    """Settings of all runs; once it is read, ``agent`` and ``policy`` are tables."""
    _tables: list[list[Table]] = PrivateAttr()

    @model_validator(mode="after")
    def _expand(self) -> SuiteFile:
        for key in NAMED:
            value = self.run.setdefault(key, {})
            if isinstance(value, str):
                self.run[key] = {"name": value}
            elif not isinstance(value, dict):
                raise ValueError(f"run.{key} must be a name or a table, not {value!r}")
        self._tables = [[_merged(self.run, cell) for cell in _cells(grid)] for grid in self.grid]
        return self

    @property
    def tables(self) -> list[list[Table]]:
        """Of each grid, the settings of each run: nested plain data, ``run`` included."""
        return self._tables

    @property
    def count(self) -> int:
        """The number of different runs."""
        return len({repr(table) for tables in self._tables for table in tables})


def suite_names() -> list[str]:
    """The suites that come with SymSteer."""
    return sorted(path.stem for path in SUITES.glob("*.toml"))


def read_suite(name_or_path: str) -> tuple[SuiteFile, Path]:
    """Read a suite by name or from a TOML file, and say where it is.

    Raises:
        UserError: if there is no such suite, or the file is not a suite.
    """
    return read_model(name_or_path, "suite", SUITES, SuiteFile)


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


def _cells(grid: Grid) -> Iterator[Table]:
    """Every combination of a grid's values, strengths joined to their variants."""
    if (count := math.prod(map(len, grid.values()))) > LARGEST_GRID:
        raise ValueError(
            f"a grid has {count} runs; it must not have more than {LARGEST_GRID}, so shorten its "
            "lists"
        )
    for values in itertools.product(*grid.values()):
        cell = dict(zip(grid, values, strict=True))
        if "strength" in cell:
            variant, strength = cell.get("variant"), cell.pop("strength")
            if not isinstance(variant, str):
                raise ValueError("grid.strength needs grid.variant, a list of names")
            if isinstance(strength, bool) or not isinstance(strength, int | float):
                raise ValueError(f"grid.strength must list numbers in [0, 1], not {strength!r}")
            cell["variant"] = with_strength(variant, strength)
        yield cell


def _merged(shared: Table, cell: Table) -> Table:
    """The shared settings, replaced by a cell's values."""
    merged = copy.deepcopy(shared)
    for key, value in cell.items():
        table = merged
        *path, last = split_key(key)
        for part in path:
            table = table.setdefault(part, {})
            if not isinstance(table, dict):
                raise ValueError(f"run.{part} must be a table, so that {key} has a place")
        table[last] = value
    return merged
