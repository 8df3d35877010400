"""The command line of ``symsteer run``.

The options depend on ``--agent NAME`` and ``--policy.name NAME``: each agent and each policy has
its own dataclass of options. So these two names are read first. Then tyro parses the whole line.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import tyro

from symsteer.agents import AGENTS
from symsteer.agents.presets import preset_options
from symsteer.bench.runs.config import RunConfig, build_config
from symsteer.bench.runs.tracking import Service
from symsteer.registry import allow

ABOUT = """Steer a base policy with one agent on one task, and record the results.

The options --agent.X are those of the agent that --agent names, the options --policy.X those of
the policy that --policy.name names.
"""


@dataclass(frozen=True)
class Execution:
    """How a run is executed. These options do not change the results."""

    out: Path = Path("runs")
    """Folder of the runs; demonstrations and base policies are kept in OUT/base."""
    demos: Path | None = None
    """Trajectory file (.h5 with .json) to train the base policy on, instead of demonstrations of
    the scripted expert."""
    base_policy: Path | None = None
    """Saved base policy (policy.safetensors) to steer, instead of training one. The run uses its
    settings and those of its demonstrations."""
    workers: int = 1
    """Processes that share the simulation; they only change the times in the record."""
    track: Service | None = None
    """Show the run in Weights & Biases, too; WANDB_MODE=offline needs no network and no login."""
    quiet: bool = False
    """No progress bars."""
    trust: tuple[str, ...] = ()
    """Code of other authors that files name, as module:Class; it is executed."""


def parse_run(arguments: Sequence[str]) -> tuple[RunConfig, Execution]:
    """Read the arguments of ``symsteer run``.

    Raises:
        UserError: if there is no such agent, policy or preset, or a value is out of range.
        SystemExit: with code 0 after ``--help``; with code 2 for an unknown option or a value that
            cannot be read. tyro has printed the help or the error.
    """
    agent = last_value(arguments, "--agent") or RunConfig.agent
    policy = last_value(arguments, "--policy.name") or RunConfig.policy_name
    preset = last_value(arguments, "--agent.preset")
    allow(agent, policy)
    defaults = RunConfig(agent=agent, policy_name=policy)
    if preset is not None:
        options = preset_options(preset, agent, AGENTS.get(agent).Options)
        start = {"agent": agent, "agent_options": options, "policy": {"name": policy}}
        defaults = build_config(start, f"preset {preset}")
    return parse(arguments, defaults)


def parse(arguments: Sequence[str], defaults: RunConfig) -> tuple[RunConfig, Execution]:
    """Parse the arguments for the agent and the policy of ``defaults``.

    Args:
        arguments: of ``symsteer run``.
        defaults: values of the options that are not given.
    """
    found: Any = tyro.cli(
        _interface(defaults), prog="symsteer run", description=ABOUT, args=arguments
    )
    values = {field.name: getattr(found.config, field.name) for field in fields(RunConfig)}
    values |= {
        "agent": defaults.agent,
        "agent_options": found.config.agent.options,
        "policy_name": defaults.policy_name,
        "policy": found.config.policy.options,
    }
    tasks = getattr(found.config.policy.options, "tasks", ())
    allow(found.config.task, found.config.variant, *tasks, *found.execution.trust)
    return RunConfig(**values), found.execution


def last_value(arguments: Sequence[str], option: str) -> str | None:
    """The value of ``--option VALUE`` or ``--option=VALUE``; the last one wins, as with tyro."""
    value = None
    for word, following in zip(arguments, [*arguments[1:], None], strict=False):
        if word == option:
            value = following
        elif word.startswith(f"{option}="):
            value = word.partition("=")[2]
    return value


def _interface(defaults: RunConfig) -> type:
    """A dataclass; tyro makes the options from its fields.

    It inherits from RunConfig, because tyro reads the help of the fields there. A field with the
    name "" adds no prefix to the options below it. This gives both ``--agent`` and
    ``--agent.gamma``.
    """
    agent_part = _dataclass(
        "AgentArguments",
        ("name", _help(str, "Agent; `symsteer list` names them.", name=""), defaults.agent),
        (
            "preset",
            _help(str | None, "Preset that replaces the defaults of these options.", "NAME"),
            None,
        ),
        _without_name("options", defaults.agent_options),
    )
    policy_part = _dataclass(
        "PolicyArguments",
        ("name", _help(str, "Policy; `symsteer list` names them."), defaults.policy_name),
        _without_name("options", defaults.policy),
    )
    config = dataclasses.make_dataclass(
        "RunArguments",
        [
            ("agent", agent_part, agent_part()),
            ("policy", policy_part, policy_part()),
            ("agent_options", Annotated[Any, tyro.conf.Suppress], None),
            ("policy_name", Annotated[Any, tyro.conf.Suppress], None),
        ],
        bases=(RunConfig,),
        frozen=True,
        # The values are checked when a RunConfig is built from them.
        namespace={"__post_init__": lambda self: None},
    )
    return _dataclass(
        "Arguments", _without_name("execution", Execution()), _without_name("config", config())
    )


def _dataclass(name: str, *members: tuple[str, Any, Any]) -> type:
    return dataclasses.make_dataclass(name, members, frozen=True)


def _help(kind: Any, text: str, metavar: str | None = None, name: str | None = None) -> Any:
    """A type with a help text for its option. Dataclasses made here have no docstrings for it."""
    return Annotated[kind, tyro.conf.arg(help=text, metavar=metavar, name=name)]


def _without_name(name: str, default: Any) -> tuple[str, Any, Any]:
    """A field with a dataclass; its options do not have the field's name as prefix."""
    return name, Annotated[type(default), tyro.conf.arg(name="")], default
