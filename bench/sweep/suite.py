"""A suite: grids of runs described in TOML.

``[grid]`` lists values of keys of ``RunConfig``, nested ones with a dot
(``"demonstrations.count"``); their product is taken in the order written. ``strength`` lists
strengths for the variants that are named without one. Several grids are written ``[[grid]]`` each.
``[run]`` sets everything that the runs share, nested as the configuration is.
"""

from __future__ import annotations

import copy
import itertools
import math
import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from symsteer.bench.runs.config import RunConfig, build_config, check_keys
from symsteer.errors import UserError

SUITES = Path(__file__).parent.parent / "suites"

LARGEST_GRID = 100_000


@dataclass(frozen=True)
class Suite:
    """A name, what it is for, and its runs in order."""

    name: str
    description: str
    runs: tuple[RunConfig, ...]


def suite_names() -> list[str]:
    """The suites that come with SymSteer."""
    return sorted(path.stem for path in SUITES.glob("*.toml"))


def load_suite(name_or_path: str) -> Suite:
    """Read a suite by name or from a TOML file.

    Raises:
        UserError: if there is no such suite, or the file says something that a run cannot be.
    """
    path = Path(name_or_path)
    if path.suffix != ".toml":
        path = SUITES / f"{name_or_path}.toml"
    try:
        data = tomllib.loads(path.read_text())
    except FileNotFoundError as error:
        raise UserError(
            f"no suite {name_or_path!r}; use one of {', '.join(suite_names())} or the path of a "
            ".toml file"
        ) from error
    except OSError as error:
        raise UserError(
            f"the suite {path} cannot be read: {error.strerror}; name another file"
        ) from error
    except (ValueError, RecursionError) as error:
        raise UserError(
            f"the suite {path.name} cannot be read as TOML: {error}; correct it there"
        ) from error
    check_keys(data, {"description", "grid", "run"}, path.name)
    shared, description = data.get("run", {}), data.get("description", "")
    if not isinstance(shared, dict):
        raise UserError(f"{path.name}: run must be a table, [run]")
    if not isinstance(description, str):
        raise UserError(f"{path.name}: description must be a text in quotes")
    grids = data.get("grid", {})
    runs: dict[RunConfig, None] = {}
    for grid in grids if isinstance(grids, list) else [grids]:
        for cell in _cells(grid, path.name):
            config = build_config(_merge(shared, cell, path.name), path.name)
            runs[config] = None
    if not runs:
        raise UserError(f"{path.name} has no runs; give it a [grid] with lists of values")
    return Suite(path.stem, description, tuple(runs))


def _cells(grid: Any, source: str) -> Iterator[dict[str, Any]]:
    """Every combination of a grid's values, strengths joined to their variants."""
    if not isinstance(grid, dict):
        raise UserError(f"{source}: grid must be a table, [grid], or several, each [[grid]]")
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
    if variant == "none" or ":" in variant:
        return variant
    if strength == 0:
        return "none"
    return "+".join(f"{name}:{strength:g}" for name in variant.split("+"))


def _merge(shared: dict[str, Any], cell: dict[str, Any], source: str) -> dict[str, Any]:
    """The shared settings with a cell's values in their places."""
    merged = copy.deepcopy(shared)
    for key, value in cell.items():
        place = merged
        *path, last = key.split(".")
        for part in path:
            place = place.setdefault(part, {})
            if not isinstance(place, dict):
                raise UserError(f"{source}: run.{part} must be a table, so that {key} has a place")
        place[last] = value
    return merged
