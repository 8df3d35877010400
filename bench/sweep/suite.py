"""A suite: the runs that the grids of a TOML file describe (``symsteer.bench.sweep.grid``).

``[run.agent]`` sets options of the agents, and the agent's name if no grid lists agents. An option
applies to those agents of a grid that have it. ``[run.agent.NAME]`` sets options of one agent only.
``preset = "NAME"`` replaces the defaults of all options by those of a preset. In a grid, the same
keys are ``"agent.OPTION"``, ``"agent.NAME.OPTION"`` and ``"agent.preset"``. ``[run.policy]`` works
in the same way, without presets.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any

from symsteer.agents import AGENTS
from symsteer.agents.presets import preset_options
from symsteer.bench.runs.config import RunConfig, build_config
from symsteer.bench.sweep.grid import SuiteData, read_suite
from symsteer.errors import UserError
from symsteer.names import unknown
from symsteer.policies import POLICIES
from symsteer.registry import Registry


@dataclass(frozen=True)
class Suite:
    """A name, what it is for, and its runs in order."""

    name: str
    description: str
    runs: tuple[RunConfig, ...]


def load_suite(name_or_path: str) -> Suite:
    """Read a suite by name or from a TOML file.

    Raises:
        UserError: if there is no such suite, or a run in it has a value or option that does not
            exist.
    """
    data = read_suite(name_or_path)
    defaults = RunConfig().to_json()
    agents = _Options("agent", AGENTS, defaults["agent"], data)
    policies = _Options("policy", POLICIES, defaults["policy"]["name"], data)
    runs: dict[RunConfig, None] = {}
    for table in data.runs:
        agent, agent_options = agents.of(table["agent"])
        policy, policy_options = policies.of(table["policy"])
        plain = {
            **table,
            "agent": agent,
            "agent_options": agent_options,
            "policy": {"name": policy, **policy_options},
        }
        runs[build_config(plain, data.source)] = None
    if not runs:
        raise UserError(f"{data.source} has no runs; give it a [grid] with lists of values")
    return Suite(data.name, data.description, tuple(runs))


class _Options:
    """The options of the agents, or policies, of a suite.

    Args:
        kind: ``agent`` or ``policy``, the key of the tables.
        registry: of the agents or policies.
        default: the name where none is given.
        data: the suite.

    Raises:
        UserError: if an option belongs to none of a grid's agents, or an agent does not exist.
    """

    def __init__(self, kind: str, registry: Registry[Any], default: str, data: SuiteData):
        self.kind, self.default, self.source = kind, default, data.source
        tables = {repr(run[kind]): run[kind] for run in data.runs}.values()
        names = dict.fromkeys(self._name(table) for table in tables)
        self.classes = {name: registry.get(name).Options for name in names}
        for table in tables:
            self._check(table)

    def of(self, table: dict[str, Any]) -> tuple[str, dict[str, Any]]:
        """Name and options of one run; options that its agent does not have are left out."""
        name = self._name(table)
        valid = _fields(self.classes[name])
        options: dict[str, Any] = {}
        if self.kind == "agent" and "preset" in table:
            options = preset_options(table["preset"], name, self.classes[name])
        options |= {key: value for key, value in table.items() if key in valid}
        return name, options | table.get(name, {})

    def _name(self, table: dict[str, Any]) -> str:
        name = table.get("name", self.default)
        if not isinstance(name, str):
            raise UserError(f"{self.source}: {self.kind} must be a text in quotes, not {name!r}")
        return name

    def _check(self, table: dict[str, Any]) -> None:
        """Refuse options that no agent of the suite has, and tables of agents that it lacks."""
        for key, value in table.items():
            if key == "name":
                continue
            if key == "preset" and self.kind == "agent":
                if not isinstance(value, str):
                    raise UserError(
                        f"{self.source}: agent.preset must be a text in quotes, not {value!r}"
                    )
            elif isinstance(value, dict):
                if key not in self.classes:
                    raise unknown(self.kind, key, self.classes, self.source)
                for option in value:
                    self._check_option(option, [key])
            else:
                self._check_option(key, list(self.classes))

    def _check_option(self, option: str, names: list[str]) -> None:
        valid = dict.fromkeys(key for name in names for key in _fields(self.classes[name]))
        if option not in valid:
            where = f"{self.source} ({self.kind} {', '.join(names)})"
            raise unknown("option", option, valid, where)


def _fields(options: type) -> list[str]:
    return [field.name for field in dataclasses.fields(options)]
