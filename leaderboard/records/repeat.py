"""The `symsteer run` command that repeats a run, from the configuration in its record."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

from symsteer.leaderboard.records.retired import without_retired
from symsteer.leaderboard.records.values import DERIVED, flat
from symsteer.terminal import option_words, to_paste

KEYS = frozenset(
    {
        *("task", "embodiment", "variant", "agent", "seed", "env_steps", "num_envs"),
        *("checkpoint_every", "sim", "device", "demonstrations", "policy"),
        *("policy_seed", "agent_options", "evaluation"),
    }
)
"""The keys of a run's configuration that are options of `symsteer run`. Others that this verb has,
such as `--runs`, are no part of a configuration, and a record must not bring them in."""

FILES = {"demonstrations": ("--demos", "FILE.h5"), "policy": ("--base-policy", "FILE.safetensors")}
"""Options and placeholders of the files from which a run may have started."""

OPTION = re.compile(r"[a-z][a-z0-9_]*(\.[a-z][a-z0-9_]*)*")
VALUE = re.compile(r"(-?\d[\w.+-]*|\w[\w.:+,=@/-]*)?", re.ASCII)
TEXTS = {"policy.instruction": re.compile(r"\w[\w ,.-]*", re.ASCII)}
"""Options that are sentences; the command has them in quotes."""


def repeat_command(config: Mapping[str, Any]) -> str | None:
    """Every option of a run as a command that `symsteer run` reads back to the same configuration.

    All options are given, so that it does not depend on defaults; those that agents have no more
    are left out. Of a run that started from files, these have placeholders: a record knows their
    contents' hashes alone.

    Returns:
        The command, or None where there is none: for configurations of other versions, such as 0.1,
        and for texts that no option has, because a reader may copy the command into a shell.
    """
    tables = config.get("agent_options"), config.get("policy")
    own = {k: v for k, v in without_retired(config, ()).items() if k not in DERIVED}
    if not own.keys() <= KEYS or not all(isinstance(table, Mapping) for table in tables):
        return None
    words = ["symsteer", "run"]
    for key, value in flat(own).items():
        name = key.replace("agent_options.", "agent.", 1)
        option = option_words(name, value)
        valid = TEXTS.get(name, VALUE)
        if not OPTION.fullmatch(name) or not all(valid.fullmatch(word) for word in option[1:]):
            return None
        words += option
    files = config.get("files")
    for key in files if isinstance(files, Mapping) else ():
        if key not in FILES:
            return None
        words += FILES[key]
    return to_paste(*words)
