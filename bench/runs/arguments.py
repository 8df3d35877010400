"""The command line of ``symsteer run``.

The options depend on ``--agent NAME`` and ``--policy.name NAME``: each agent and each policy has
its own dataclass of options. So these two names are read first. Then tyro parses the whole line.
"""

from __future__ import annotations

import argparse
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
    early = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    for option in (*NAMES, "--agent.preset"):
        early.add_argument(option, action="extend", nargs="*", default=[])
    given = vars(early.parse_known_args(arguments)[0])
    preset = given.pop("agent.preset")
    # What a user types by these names may be executed; the name of a file is no consent.
    allow(*(value for values in given.values() for value in values))
    agent = [RunConfig.agent, *given["agent"]][-1]
    names = {"agent": agent, "policy": {"name": [RunConfig.policy_name, *given["policy.name"]][-1]}}
    options = preset_options(preset[-1], agent, AGENTS.get(agent).Options) if preset else {}
    defaults = build_config({**names, "agent_options": options}, "symsteer run")
    # What is not given follows the run's seed and task, which are not known yet.
    later = {"policy": type(defaults.policy)(), "demonstrations": DemonstrationConfig()}
    vars(defaults).update(policy_seed=None, **later)
    parsed = tyro.cli(
        _Arguments,
        prog="symsteer run",
        description=ABOUT,
        # `all` of `--help all`, see `brief`.
        args=arguments[: 1 + arguments.index("--help")] if "--help" in arguments else arguments,
        default=_Arguments(Execution(), defaults),
    )
    return parsed.config, parsed.execution
