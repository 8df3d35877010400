"""The command line of ``symsteer run``.

The options depend on ``--agent NAME`` and ``--policy.name NAME``: each agent and each policy has
its own dataclass of options. So these two names are read first. Then tyro parses the whole line.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import tyro

from symsteer.agents import AGENTS
from symsteer.agents.presets import preset_options
from symsteer.bench.runs.config import DemonstrationConfig, Execution, RunConfig, build_config
from symsteer.registry import allow

ABOUT = """Steer a base policy with one agent on one task, and record the results.

The options --agent.X are those of the agent that --agent names, the options --policy.X those of
the policy that --policy.name names.
"""

NAMES = ("--agent", "--policy.name", "--task", "--policy.tasks", "--variant", "--trust")
"""Options that name classes."""

DEFAULTS = {"--agent": RunConfig.agent, "--policy.name": RunConfig.policy_name}


@dataclass(frozen=True)
class _Arguments:
    execution: Annotated[Execution, tyro.conf.arg(name="")]
    config: Annotated[RunConfig, tyro.conf.arg(name="")]
    preset: Annotated[str | None, tyro.conf.arg(name="agent.preset", metavar="NAME")] = None
    """Preset that replaces the defaults of the agent's options."""


def parse_run(arguments: Sequence[str]) -> tuple[RunConfig, Execution]:
    """Read the arguments of ``symsteer run``.

    Raises:
        UserError: if there is no such agent, policy or preset, or a value is out of range.
        SystemExit: with code 0 after ``--help``; with code 2 for an unknown option or a value that
            cannot be read. tyro has printed the help or the error.
    """
    given = _values(arguments)
    # What a user types by these names may be executed; the name of a file is no consent.
    allow(*(value for option in NAMES for value in given.get(option, ())))
    agent, policy = (given.get(option, [name])[-1] for option, name in DEFAULTS.items())
    options = {}
    if preset := given.get("--agent.preset"):
        options = preset_options(preset[-1], agent, AGENTS.get(agent).Options)
    names = {"agent": agent, "policy": {"name": policy}}
    defaults = build_config({**names, "agent_options": options}, "symsteer run")
    # A seed that is not given follows the run's seed, which is not known yet.
    vars(defaults).update(policy_seed=None, demonstrations=DemonstrationConfig())
    parsed = tyro.cli(
        _Arguments,
        prog="symsteer run",
        description=ABOUT,
        args=arguments,
        default=_Arguments(Execution(), defaults),
    )
    return parsed.config, parsed.execution


def _values(arguments: Sequence[str]) -> dict[str, list[str]]:
    """The values of each option, written as ``--option VALUE`` or ``--option=VALUE``."""
    values: dict[str, list[str]] = {}
    option = ""
    for word in arguments:
        if word.startswith("--"):
            option, equals, word = word.partition("=")
            if not equals:
                continue
        values.setdefault(option, []).append(word)
    return values
