"""Runs as their folders hold them: configuration, base policy, trained agent."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import torch

from symsteer.agents import AGENTS
from symsteer.bench.runs.checkpoint import fitting, load_checkpoint
from symsteer.bench.runs.config import RunConfig, build_config
from symsteer.bench.runs.evaluator import Steered, new_agent
from symsteer.bench.runs.folder import CHECKPOINT, CONFIG, RECORD, read_config
from symsteer.bench.tasks import TASKS, task_class
from symsteer.bench.variants import VARIANTS
from symsteer.errors import UserError
from symsteer.leaderboard.records import DERIVED, flat, read_record, run_id_of
from symsteer.policies import POLICIES
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.files import load_policy, policy_path
from symsteer.registry import Extension

REGISTRIES = {registry.kind: registry for registry in (AGENTS, POLICIES, TASKS, VARIANTS)}


@dataclass(frozen=True)
class RunFolder:
    """The folder of a run, whether it exists or not, and what is run there.

    Attributes:
        folder: of the run; its name is the run's name.
        config: of the run.
        resolved: the configuration as plain data, as `config.json` and the record have it.
    """

    folder: Path
    config: RunConfig
    resolved: Mapping[str, Any]

    @classmethod
    def stored(cls, folder: Path) -> Self:
        """The run of a folder, which may be given as ``.`` or as a link.

        Raises:
            UserError: if it is not the folder of a run, or its configuration is damaged, edited, or
                of a version with fewer options.
        """
        folder = Path(os.path.realpath(folder))
        resolved = read_config(folder)
        config = read_back(resolved, folder / CONFIG, folder / RECORD)
        if newer := newer_options(config, resolved):
            raise UserError(
                f"the run {folder.name} was begun by an older version, without {', '.join(newer)}; "
                "use that version for it, or start it again with `symsteer run`"
            )
        files = resolved.get("files", {})
        if not isinstance(files, dict) or run_id_of({**resolved, "files": files}) != folder.name:
            raise UserError(
                f"{folder / CONFIG} does not belong to a folder of this name: it was edited, or "
                "the folder renamed; undo that"
            )
        return cls(folder, config, resolved)

    @property
    def files(self) -> dict[str, str]:
        """Content hashes of the files that it started from."""
        return self.resolved.get("files", {})

    def policy(self) -> ChunkPolicy | None:
        """Its base policy; None if it is not there yet."""
        if not policy_path(self.folder).is_file():
            return None
        task = task_class(self.config.task)
        policy = load_policy(self.folder, task.observation_layout, task.action_layout)
        return policy.to(self.config.device)


@dataclass(eq=False)
class Restored(Steered):
    """A run at its last checkpoint.

    Attributes:
        folder: of the run.
        state: the whole checkpoint.
    """

    folder: Path
    state: Mapping[str, Any]


def restored(folder: Path) -> Restored:
    """Read a run's last checkpoint.

    A run that was trained on a GPU comes back on the CPU where there is none.

    Raises:
        UserError: if the folder is not a run's, it has no checkpoint yet, or a file is damaged.
    """
    run = RunFolder.stored(folder)
    if not torch.cuda.is_available():
        run = dataclasses.replace(run, config=dataclasses.replace(run.config, device="cpu"))
    state = load_checkpoint(run.folder)
    if state is None:
        raise UserError(
            f"the run {run.folder.name} has no checkpoint yet; `symsteer resume` brings it to its "
            "end"
        )
    policy = run.policy()
    if policy is None or policy.content_hash() != state["base_policy"]:
        raise UserError(
            f"{policy_path(run.folder)} is not the base policy that the checkpoint of "
            f"{run.folder.name} steers; restore it from where the run was made"
        )
    agent = new_agent(run.config, policy)
    with fitting(run.folder / CHECKPOINT):
        agent.load_state_dict(state["agent"])
    return Restored(run.config, policy, agent, run.folder, state)


def read_back(data: Mapping[str, Any], path: Path, record: Path) -> RunConfig:
    """A run's configuration from its resolved configuration.

    Args:
        data: as `config.json` and records have it.
        path: the file that it is from, for messages.
        record: of the run; all code from outside SymSteer that it names must be installed. A record
            that is missing or damaged names none.

    Raises:
        UserError: if this version has no such configuration, or code is not installed.
    """
    if "sac" in data:
        raise UserError(
            f"{path} is of a run of SymSteer 0.1, which this version reports but cannot load, "
            "continue or repeat; use SymSteer 0.1 for that"
        )
    try:
        extensions = read_record(record).provenance.extensions
    except UserError:
        extensions = []
    for one in extensions:
        REGISTRIES[one.kind].require(one.name, one.target, one.distribution, record)
    asked = {key: value for key, value in data.items() if key not in DERIVED}
    return build_config(asked, str(path))


def newer_options(config: RunConfig, data: Mapping[str, Any]) -> list[str]:
    """Options that a stored configuration ``data`` lacks; ``config`` has their defaults."""
    return sorted(flat(config.to_json()).keys() - flat(data).keys())


def extensions_of(config: RunConfig) -> list[Extension]:
    """The agent, policy, task and variants of a run that are not SymSteer's own."""
    named = [
        AGENTS.extension(config.agent),
        POLICIES.extension(config.policy_name),
        TASKS.extension(config.task),
        *(VARIANTS.extension(spec.name) for spec in config.variants),
    ]
    return [extension for extension in named if extension is not None]
