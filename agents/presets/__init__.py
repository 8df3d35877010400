"""Presets: named settings of agents as data, one TOML file each.

The table ``[all]`` has options for every agent that knows them. A table with an agent's name has
options for this agent only and has priority.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

from pydantic import RootModel

from symsteer.files import read_model
from symsteer.names import check

T = TypeVar("T", bound=Any)

FOLDER = Path(__file__).parent


def preset_options(name: str, agent: str, options: type) -> dict[str, Any]:
    """What a preset sets for an agent.

    Args:
        name: one of those of this folder, or the path of a ``.toml`` file.
        agent: name of the agent.
        options: its dataclass of options.

    Raises:
        UserError: if there is no such preset, it is damaged, or it sets an option of the agent's
            own table that the agent does not have.
    """
    preset, path = read_model(name, "preset", FOLDER, RootModel[dict[str, dict[str, Any]]])
    tables = preset.root
    valid = [field.name for field in dataclasses.fields(options)]
    of_agent = tables.get(agent, {})
    check(f"option of {agent}", of_agent, valid, path.name)
    return {key: value for key, value in tables.get("all", {}).items() if key in valid} | of_agent


def defaults_of(preset: str) -> Callable[[type[T]], type[T]]:
    """Class decorator: the agent's options have the defaults that a preset has for it.

    Options that the preset does not set keep their defaults.
    """

    def decorate(agent: type[T]) -> type[T]:
        chosen = preset_options(preset, agent.name, agent.Options)
        agent.Options = _with_defaults(agent, chosen)
        return agent

    return decorate


def _with_defaults(agent: Any, chosen: dict[str, Any]) -> type:
    base = agent.Options
    # As types: names of types mean nothing in the agent's module.
    types = get_type_hints(base)
    options = dataclasses.make_dataclass(
        "Options",
        [
            (field.name, types[field.name], chosen[field.name])
            for field in dataclasses.fields(base)
            if field.name in chosen
        ],
        bases=(base,),
        frozen=True,
        namespace={"__doc__": base.__doc__, "__qualname__": f"{agent.__qualname__}.Options"},
    )
    # Options that are sent to another process find their class by this and the qualified name.
    # Python 3.12 and later overwrite what a namespace says of it.
    options.__module__ = agent.__module__
    return options
