"""A suite: the runs that the grids of a TOML file describe (``symsteer.bench.sweep.grid``).

``[run.agent]`` sets options of the agents, and the agent's name if no grid lists agents. An option
applies to those agents of a grid that have it. ``[run.agent.NAME]`` sets options of one agent only.
``preset = "NAME"`` replaces the defaults of all options by those of a preset. In a grid, the same
keys are ``"agent.OPTION"``, ``"agent.NAME.OPTION"`` and ``"agent.preset"``. ``[run.policy]`` works
in the same way, without presets.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from symsteer.agents import AGENTS
from symsteer.bench.runs.config import RunConfig, build_config
from symsteer.bench.sweep.grid import SuiteData, read_suite
from symsteer.errors import UserError
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
        self.classes: dict[str, Any] = {}
        for grid in data.grids:
            for table in grid:
                name = self._name(table[kind])
                if name not in self.classes:
                    self.classes[name] = registry.get(name).Options
        everywhere = list(self.classes)
        for grid in data.grids:
            present = list(dict.fromkeys(self._name(table[kind]) for table in grid))
            for table in {repr(table[kind]): table[kind] for table in grid}.values():
                self._check(table, present, everywhere)
