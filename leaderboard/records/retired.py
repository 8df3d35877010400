"""Options that agents once had and have no more.

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
}
"""Options of the SAC agents, and the one value that was ever used."""

SAC_OPTION = "target_entropy"
"""An option that all SAC agents have, and no others."""


def with_retired(config: Mapping[str, Any]) -> dict[str, Any]:
    """A configuration in which no retired option is missing, to compare old and new ones."""
    options = config.get("agent_options")
    if not isinstance(options, Mapping) or SAC_OPTION not in options:
        return dict(config)
    return {**config, "agent_options": {**RETIRED, **options}}


def without_retired(options: Mapping[str, Any], known: Collection[str]) -> dict[str, Any]:
    """Options of an agent without the retired ones whose value still means the same.

    Args:
        options: as a record has them.
        known: the options that the agent has today.
    """
    return {
        name: value
        for name, value in options.items()
        if name in known or name not in RETIRED or value != RETIRED[name]
    }
