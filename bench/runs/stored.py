"""Reading a run's folder: configuration, base policy, trained agent."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from symsteer.agents.agent import Agent
from symsteer.bench.runs.checkpoint import fitting, load_checkpoint
from symsteer.bench.runs.config import RunConfig, build_config
from symsteer.bench.runs.extensions import require_extensions
from symsteer.bench.runs.folder import CHECKPOINT, CONFIG, RECORD, read_config, run_id
from symsteer.bench.runs.trainer import new_agent
from symsteer.bench.tasks import task_class
from symsteer.errors import UserError
from symsteer.leaderboard.records import DERIVED, flat
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.files import load_policy, policy_path


@dataclass(frozen=True)
class Restored:
    """A run at its last checkpoint.

    Attributes:
        folder: of the run.
        config: of the run; with the device on which it was restored.
        policy: the frozen base policy.
        agent: with the weights of the checkpoint.
        state: the whole checkpoint.
    """

    folder: Path
    config: RunConfig
    policy: ChunkPolicy
    agent: Agent
    state: Mapping[str, Any]


def restored(folder: Path) -> Restored:
    """Read a run's last checkpoint.

    A run that was trained on a GPU comes back on the CPU where there is none.

    Raises:
        UserError: if the folder is not a run's, it has no checkpoint yet, or a file is damaged.
    """
    folder = named(folder)
    config, _ = stored_config(folder)
    if not torch.cuda.is_available():
        config = replace(config, device="cpu")
    state = load_checkpoint(folder)
    if state is None:
        raise UserError(
            f"the run {folder.name} has no checkpoint yet; `symsteer resume` brings it to its end"
        )
    policy = stored_policy(folder, config)
    if policy is None or policy.content_hash() != state["base_policy"]:
        raise UserError(
            f"{policy_path(folder)} is not the base policy that the checkpoint of {folder.name} "
            "steers; restore it from where the run was made"
        )
    agent = new_agent(config, policy)
    with fitting(folder / CHECKPOINT):
        agent.load_state_dict(state["agent"])
    return Restored(folder, config, policy, agent, state)


def named(folder: Path) -> Path:
    """The folder's full path, also for ``.`` or a link: its name is the run's name."""
    return Path(os.path.realpath(folder))


def stored_config(folder: Path) -> tuple[RunConfig, dict[str, Any]]:
    """Configuration of a run's folder, and the content hashes of the files it started from.

    Raises:
        UserError: if the folder is not a run's, or its configuration is damaged, edited, or of a
            version with fewer options.
    """
    data = read_config(folder)
    config, files = read_back(data, folder / CONFIG, folder / RECORD)
    if newer := newer_options(config, data):
        raise UserError(
            f"the run {folder.name} was begun by an older version, without {', '.join(newer)}; "
            "use that version for it, or start it again with `symsteer run`"
        )
    own = {key: value for key, value in data.items() if key not in DERIVED}
    if not isinstance(files, dict) or run_id(config, files, own) != folder.name:
        raise UserError(
            f"{folder / CONFIG} does not belong to a folder of this name: it was edited, or the "
            "folder renamed; undo that"
        )
    return config, files


def read_back(data: Mapping[str, Any], path: Path, record: Path) -> tuple[RunConfig, Any]:
    """A run's configuration, and the content hashes of its files, from its resolved configuration.

    Args:
        data: as `config.json` and records have it.
        path: the file that it is from, for messages.
        record: of the run; all code that it names must be installed.

    Raises:
        UserError: if this version has no such configuration, or code is not installed.
    """
    if "sac" in data:
        raise UserError(
            f"{path} is of a run of SymSteer 0.1, which this version reports but cannot load, "
            "continue or repeat; use SymSteer 0.1 for that"
        )
    require_extensions(record)
    own = {key: value for key, value in data.items() if key not in DERIVED}
    return build_config(own, str(path)), data.get("files", {})


def newer_options(config: RunConfig, data: Mapping[str, Any]) -> list[str]:
    """Options that a stored configuration ``data`` lacks; ``config`` has their defaults."""
    return sorted(flat(config.to_json()).keys() - flat(data).keys())


def stored_policy(folder: Path, config: RunConfig) -> ChunkPolicy | None:
    """The base policy in a run's folder; None if it is not there yet."""
    if not policy_path(folder).is_file():
        return None
    task = task_class(config.task)
    base = load_policy(folder, task.observation_layout, task.action_layout)
    return base.to(config.device)
