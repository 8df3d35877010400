"""What is taken away: the base policy and the demonstrations of a run, or of settings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from symsteer.bench.runs.base_policy import (
    demonstration_file,
    demonstration_path,
    find_base,
    prepare_base,
)
from symsteer.bench.runs.config import RunConfig
from symsteer.bench.runs.run import check
from symsteer.bench.runs.stored import named, stored_config
from symsteer.bench.tasks import task_class
from symsteer.errors import UserError
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.files import load_policy, policy_path

Wanted = Literal["all", "demonstrations", "policy"]


@dataclass(frozen=True)
class Contents:
    """Files that are taken away together.

    Attributes:
        name: of all of them: that of the policy's folder in RUNS/base, or of the demonstrations.
        config: task, embodiment, and the settings of demonstrations and policy.
        demonstrations: the .h5 file, its .json next to it; None if they are not taken.
        policy: the base policy, on the CPU; None if it is not taken.
        policy_file: of the policy.
        origin: content hashes of files of the user that the policy came from; empty if it is the
            one in RUNS/base.
        left_out: why the demonstrations are not here though they were wanted; None otherwise.
    """

    name: str
    config: RunConfig
    demonstrations: Path | None
    policy: ChunkPolicy | None
    policy_file: Path | None
    origin: Mapping[str, str]
    left_out: str | None = None


def contents_of_run(folder: Path, wanted: Wanted) -> Contents:
    """The base policy of a run, and its demonstrations where the folder ``base`` has them.

    Raises:
        UserError: if the folder is not a run's, or what is wanted is not there.
    """
    folder = named(folder)
    config, origin = stored_config(folder)
    if not policy_path(folder).is_file():
        raise UserError(
            f"the run {folder.name} has no base policy yet; `symsteer resume` brings it to its end"
        )
    task = task_class(config.task)
    policy = load_policy(folder, task.observation_layout, task.action_layout)
    base = find_base(config, folder.parent)
    # A policy that came from a file of the user has the settings of another one in ``base``.
    if base is not None and load_policy(base).content_hash() == policy.content_hash():
        demonstrations = demonstration_path(config, folder.parent)
        if wanted == "demonstrations":
            return _demonstrations_alone(config, demonstrations)
        taken, left_out = _taken(config, demonstrations, wanted)
        return Contents(base.name, config, taken, policy, policy_path(folder), {}, left_out)
    absent = (
        f"{folder.parent / 'base'} does not have the demonstrations that the base policy of "
        f"{folder.name} was trained on"
    )
    if wanted == "demonstrations":
        raise UserError(f"{absent}; export the policy alone with --contents policy")
    kind = config.policy_name.rpartition(":")[2]
    name = f"{config.task}-{config.embodiment}-{kind}-{policy.content_hash()[:12]}"
    left_out = absent if wanted == "all" else None
    return Contents(name, config, None, policy, policy_path(folder), origin, left_out)


def contents_of_settings(config: RunConfig, runs: Path, wanted: Wanted) -> Contents:
    """Demonstrations and base policy of settings; what ``runs/base`` lacks is made.

    Raises:
        UserError: for an unknown task or embodiment, or if nothing can be written to ``runs``.
    """
    check(config)
    demonstrations = demonstration_file(config, runs)
    if wanted == "demonstrations":
        return _demonstrations_alone(config, demonstrations)
    policy = prepare_base(config, runs)
    folder = find_base(config, runs)
    assert folder is not None, "prepare_base keeps it there"
    taken, left_out = _taken(config, demonstrations, wanted)
    return Contents(folder.name, config, taken, policy, policy_path(folder), {}, left_out)


def _taken(config: RunConfig, path: Path, wanted: Wanted) -> tuple[Path | None, str | None]:
    """The demonstrations that go with a policy, or why they do not."""
    if wanted != "all" or len(config.policy_tasks) == 1:
        return (path if wanted == "all" else None), None
    tasks = ", ".join(config.policy_tasks)
    return None, (
        f"the policy was trained on demonstrations of {tasks}; export them one task at a time, "
        "with --contents demonstrations"
    )


def _demonstrations_alone(config: RunConfig, path: Path) -> Contents:
    return Contents(path.stem, config, path, None, None, {})
