"""A suite: the runs that the grids of a TOML file describe (``symsteer.bench.sweep.grid``).

``[run.agent]`` sets options of the agents, and the agent's name if no grid lists agents. An option
applies to those agents of a grid that have it. ``[run.agent.NAME]`` sets options of one agent only.
``preset = "NAME"`` replaces the defaults of all options by those of a preset. In a grid, the same
keys are ``"agent.OPTION"``, ``"agent.NAME.OPTION"`` and ``"agent.preset"``. ``[run.policy]`` works
in the same way, without presets.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, fields
from typing import Any

from symsteer.agents import AGENTS
from symsteer.agents.presets import preset_options
from symsteer.bench.runs.config import RunConfig, build_config
from symsteer.bench.sweep.grid import SuiteFile, read_suite, split_key
from symsteer.errors import UserError
from symsteer.names import check, unknown
from symsteer.policies import POLICIES
from symsteer.registry import Registry


@dataclass(frozen=True)
class Suite:
    """Name, description, and the runs in order."""

    name: str
    description: str
    runs: tuple[RunConfig, ...]


def load_suite(name_or_path: str) -> Suite:
    """Read a suite by name or from a TOML file.

    Raises:
        UserError: if there is no such suite, it has no runs, or a run in it has a value or option
            that does not exist.
    """
    file, path = read_suite(name_or_path)
    runs = runs_of(file, path.name)
    if not runs:
        raise UserError(f"{path.name} has no runs; give it a [grid] with lists of values")
    return Suite(path.stem, file.description, runs)


def runs_of(file: SuiteFile, source: str) -> tuple[RunConfig, ...]:
    """The runs of a suite, each once.

    Args:
        file: the suite.
        source: name of its file, for messages.

    Raises:
        UserError: if a run has a value or option that does not exist.
    """
    defaults = RunConfig()
    agents = _Options("agent", AGENTS, defaults.agent, ("name", "preset"))
    policies = _Options("policy", POLICIES, defaults.policy_name, ("name",))
    runs: dict[RunConfig, None] = {}
    try:
        for grid, tables in zip(file.grid, file.tables, strict=True):
            agents.names, policies.names = {}, {}
            for table in tables:
                agent, agent_options = agents.of(table["agent"])
                policy, policy_options = policies.of(table["policy"])
                plain = {
                    **table,
                    "agent": agent,
                    "agent_options": agent_options,
                    "policy": {"name": policy, **policy_options},
                }
                runs[build_config(plain, source)] = None
            for options in (agents, policies):
                paths = [path[1:] for path in map(split_key, grid) if path[0] == options.kind]
                options.refuse_unused(paths, list(options.names))
        for options in (agents, policies):
            options.refuse_unused(_paths(file.run[options.kind]), list(options.valid))
    except UserError as error:
        where = "" if str(error).startswith(source) else f"{source}: "
        raise UserError(f"{where}{error}") from error
    return tuple(runs)


class _Options:
    """Chooses the options of the agents, or of the policies, of a suite.

    Args:
        kind: ``agent`` or ``policy``, the key of the tables.
        registry: of the agents or policies.
        default: the name if none is given.
        reserved: keys of the tables that are no options.
    """

    def __init__(
        self, kind: str, registry: Registry[Any], default: str, reserved: tuple[str, ...]
    ) -> None:
        self.kind, self.registry, self.default, self.reserved = kind, registry, default, reserved
        self.valid: dict[str, list[str]] = {}
        """The options of those that the suite names."""
        self.names: dict[str, None] = {}
        """Those that the present grid names."""

    def of(self, table: dict[str, Any]) -> tuple[str, dict[str, Any]]:
        """The name and the options of one run's table."""
        name = self._text(table.get("name", self.default), "name")
        kind = self.registry.get(name).Options
        valid = self.valid.setdefault(name, [field.name for field in fields(kind)])
        self.names[name] = None
        of_name = table.get(name, {})
        options = table | of_name if isinstance(of_name, dict) else table
        preset: dict[str, Any] = {}
        if "preset" in options and "preset" in self.reserved:
            source = self._text(options["preset"], "preset")
            preset = preset_options(source, name, kind)
            build_config({"agent": name, "agent_options": preset}, f"preset {source}")
        chosen = {
            key: value
            for key, value in options.items()
            if key in valid and not isinstance(value, dict)
        }
        return name, preset | chosen

    def _text(self, value: Any, key: str) -> str:
        if not isinstance(value, str):
            raise UserError(f"{self.kind}.{key} must be a text in quotes, not {value!r}")
        return value

    def refuse_unused(self, paths: Iterable[list[str]], names: list[str]) -> None:
        """Refuse an ``[option]``, or ``[name, option]``, that none of the named ones has."""
        for *owner, option in paths:
            check(self.kind, owner, names, self.kind)
            owners = owner or names
            valid = dict.fromkeys(field for name in owners for field in self.valid[name])
            if option not in (*self.reserved, *valid):
                where = f"{self.kind} {', '.join(owners)}"
                raise unknown(f"{self.kind} option", option, valid, where)


def _paths(table: dict[str, Any]) -> list[list[str]]:
    """The options of a shared table: ``[option]``, or ``[name, option]`` from a table in it."""
    return [
        path
        for key, value in table.items()
        for path in ([[key, option] for option in value] if isinstance(value, dict) else [[key]])
    ]
