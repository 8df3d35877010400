"""Options that agents once had and have no more, or have by another name.

A record keeps the configuration that it was made with, and its hash. Today's code does what it did
with the value in `RETIRED`. So a configuration without such an option means the same as one with
this value, and one with another value cannot be repeated.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from typing import Any

from pydantic import JsonValue

RETIRED: dict[str, JsonValue] = {
    "subset": 2,
    "n_step": 1,
    "bound_penalty": 0.0,
    "learning_starts": None,
    "actor_delay": 0,
    "demonstration_share": 0.0,
    "warmup_noise": "gaussian",
    "initial_scale": 0.5,
}
"""Options of the SAC agents, and the one value that was ever used."""

RETIRED_BESIDE: dict[str, dict[str, JsonValue]] = {
    "penalty": {"actor_penalty": None, "critic_penalty": None},
    "dual_lr": {"slack_price": 1.0},
}
"""Options of those of them that have another option."""

RETIRED_OF_AGENTS: dict[str, dict[str, JsonValue]] = {
    "augmented": {"augmentation": "C8"},
    "slow": {"bias_speed": 1.0, "start": 0, "shared": False},
}
"""Options of one agent alone."""

RETIRED_OF_RUNS: dict[str, JsonValue] = {"keep_replay": False}
"""Options of runs of any agent."""

RENAMED = {"critic": "critic_kind"}
"""Options of the SAC agents by their first name, and their name today."""

POLICY_OPTION = "process"
"""An option of policies that came with those of runs: older configurations have neither."""

SAC_OPTION = "target_entropy"
"""An option that all SAC agents have, and no others."""


def with_retired(config: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration with all retired options and today's names, to compare old and new ones."""
    policy, options = config.get("policy"), config.get("agent_options")
    is_old = not isinstance(policy, Mapping) or POLICY_OPTION not in policy
    whole = dict(config) if is_old else {**RETIRED_OF_RUNS, **config}
    if isinstance(options, Mapping):
        whole["agent_options"] = {**_retired_of(config), **_named_as_today(options)}
    return whole


def with_first_names(config: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration with the first name of every option: its hash outlives new names."""
    first = {new: old for old, new in RENAMED.items()}
    options = config.get("agent_options")
    if not isinstance(options, Mapping) or SAC_OPTION not in options:
        return dict(config)
    named = {first.get(name, name): value for name, value in options.items()}
    return {**config, "agent_options": named}


def without_retired(config: Mapping[str, Any], known: Collection[str]) -> dict[str, Any]:
    """A configuration with today's names, without retired options that still mean the same.

    Args:
        config: as a record has it.
        known: the options that its agent has today.
    """
    kept = _without(config, RETIRED_OF_RUNS, ())
    options = kept.get("agent_options")
    if isinstance(options, Mapping):
        named = options if RENAMED.keys() & set(known) else _named_as_today(options)
        kept["agent_options"] = _without(named, _retired_of(config), known)
    return kept


def _named_as_today(options: Mapping[str, Any]) -> dict[str, Any]:
    renamed = RENAMED if SAC_OPTION in options else {}
    return {renamed.get(name, name): value for name, value in options.items()}


def _retired_of(config: Mapping[str, Any]) -> dict[str, JsonValue]:
    """The options that the agent of a configuration once had."""
    options = config["agent_options"]
    if SAC_OPTION not in options:
        return {}
    retired = dict(RETIRED)
    for option, beside in RETIRED_BESIDE.items():
        retired |= beside if option in options else {}
    return retired | RETIRED_OF_AGENTS.get(config.get("agent", ""), {})


def _without(
    options: Mapping[str, Any], retired: Mapping[str, Any], known: Collection[str]
) -> dict[str, Any]:
    return {
        name: value
        for name, value in options.items()
        if name in known or name not in retired or value != retired[name]
    }
