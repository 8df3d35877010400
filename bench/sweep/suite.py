"""A suite: the runs that the grids of a TOML file describe (``symsteer.bench.sweep.grid``).

``[run.agent]`` sets options of the agents, and the agent's name if no grid lists agents. An option
applies to those agents of a grid that have it. ``[run.agent.NAME]`` sets options of one agent only.
``preset = "NAME"`` replaces the defaults of all options by those of a preset. In a grid, the same
keys are ``"agent.OPTION"``, ``"agent.NAME.OPTION"`` and ``"agent.preset"``. ``[run.policy]`` works
in the same way, without presets.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

from symsteer.agents import AGENTS
from symsteer.agents.presets import preset_options
from symsteer.bench.runs.config import RunConfig, build_config
from symsteer.bench.sweep.grid import SuiteData, read_suite, split_key
from symsteer.errors import UserError
from symsteer.names import check
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
        UserError: if there is no such suite, or a run in it has a value or option that does not
            exist.
    """
    return suite_of(read_suite(name_or_path))


def suite_of(data: SuiteData) -> Suite:
    """The runs of a suite.

    Raises:
        UserError: if it has no runs, or a run in it has a value or option that does not exist.
    """
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
    """The options of the agents, or of the policies, of a suite.

    Args:
        kind: ``agent`` or ``policy``, the key of the tables.
        registry: of the agents or policies.
        default: the name if none is given.
        data: the suite.

    Raises:
        UserError: if a name does not exist, or no agent (policy) has an option that is set for it.
    """

    def __init__(self, kind: str, registry: Registry[Any], default: str, data: SuiteData):
        self.kind, self.default, self.source = kind, default, data.source
        self.reserved = ("name", "preset") if kind == "agent" else ("name",)
        present = [dict.fromkeys(self._name(run[kind]) for run in grid.runs) for grid in data.grids]
        everywhere = dict.fromkeys(name for names in present for name in names)
        try:
            self.classes = {name: registry.get(name).Options for name in everywhere}
        except UserError as error:
            raise UserError(f"{self.source}: {error}") from error
        for key, value in data.shared[kind].items():
            if isinstance(value, dict) and key not in self.reserved:
                for option in value:
                    self._check([key, option], list(everywhere))
            else:
                self._check([key], list(everywhere))
        for grid, names in zip(data.grids, present, strict=True):
            for path in map(split_key, grid.keys):
                if path[0] == kind:
                    self._check(path[1:], list(names))

    def of(self, table: dict[str, Any]) -> tuple[str, dict[str, Any]]:
        """The name and the options of one run's table."""
        name = self._name(table)
        own = table.get(name, {})
        options = {key: value for key, value in table.items() if not isinstance(value, dict)}
        options |= own if isinstance(own, dict) else {}
        start: dict[str, Any] = {}
        if self.kind == "agent" and "preset" in options:
            preset = self._text(options["preset"], "preset")
            start = preset_options(preset, name, self.classes[name])
            build_config({"agent": name, "agent_options": start}, f"preset {preset}")
        valid = _fields(self.classes[name])
        return name, start | {key: value for key, value in options.items() if key in valid}

    def _name(self, table: dict[str, Any]) -> str:
        return self._text(table.get("name", self.default), "name")

    def _text(self, value: Any, key: str) -> str:
        if not isinstance(value, str):
            raise UserError(
                f"{self.source}: {self.kind}.{key} must be a text in quotes, not {value!r}"
            )
        return value

    def _check(self, path: list[str], names: list[str]) -> None:
        """Refuse an ``[option]``, or ``[name, option]``, that none of the named agents has."""
        *owner, option = path
        check(self.kind, owner, names, f"{self.source}, {self.kind}.{''.join(owner)}")
        names = owner or names
        valid = dict.fromkeys(field for name in names for field in _fields(self.classes[name]))
        if option not in self.reserved:
            where = f"{self.source} ({self.kind} {', '.join(names)})"
            check(f"{self.kind} option", [option], valid, where)


def _fields(options: Any) -> list[str]:
    return [field.name for field in fields(options)]
