"""A suite: a grid of runs described in TOML.

``[grid]`` lists values of top-level keys of :class:`bench.runs.config.RunConfig` whose product is
taken, in the order written; ``[run]`` sets everything that the runs share, nested as the
configuration is.
"""

from __future__ import annotations

import difflib
import itertools
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from bench.runs.config import RunConfig
from policies.errors import UserError

SUITES = Path(__file__).parent.parent / "suites"


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
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError) as error:
        raise UserError(f"the suite {path.name} cannot be read as TOML: {error}") from error
    _check_keys(data, {"description", "grid", "run"}, path.name)
    grid = data.get("grid", {})
    for key, values in grid.items():
        if not isinstance(values, list) or not values:
            raise UserError(f"{path.name}: grid.{key} must be a list with at least one value")
    runs = []
    for values in itertools.product(*grid.values()):
        cell = dict(zip(grid, values, strict=True))
        runs.append(build_config({**data.get("run", {}), **cell}, path.name))
    return Suite(path.stem, data.get("description", ""), tuple(runs))


def build_config(data: dict[str, Any], source: str) -> RunConfig:
    """A run's configuration from nested plain data; what is left out keeps its default.

    Raises:
        UserError: on an unknown key (with the nearest valid one) or a value of a wrong type.
    """
    defaults = RunConfig().to_json()
    _check_nested_keys(data, defaults, source, "")
    try:
        return TypeAdapter(RunConfig).validate_python(_merge(defaults, data))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        raise UserError(f"{source}: {key}: {first['msg']} (got {first['input']!r})") from error


def _merge(defaults: dict[str, Any], data: dict[str, Any]) -> dict[str, Any]:
    return {
        key: _merge(value, data[key])
        if key in data and isinstance(value, dict)
        else data.get(key, value)
        for key, value in defaults.items()
    }


def _check_nested_keys(
    data: dict[str, Any], defaults: dict[str, Any], source: str, prefix: str
) -> None:
    _check_keys(data, set(defaults), source, prefix)
    for key, value in data.items():
        if isinstance(defaults[key], dict):
            if not isinstance(value, dict):
                raise UserError(f"{source}: {prefix}{key} must be a table, not {value!r}")
            _check_nested_keys(value, defaults[key], source, f"{prefix}{key}.")


def _check_keys(data: dict[str, Any], valid: set[str], source: str, prefix: str = "") -> None:
    for key in data:
        if key not in valid:
            close = difflib.get_close_matches(key, valid, n=1)
            hint = (
                f"did you mean {prefix}{close[0]}?"
                if close
                else f"valid: {', '.join(sorted(valid))}"
            )
            raise UserError(f"{source}: there is no key {prefix + key!r}; {hint}")
