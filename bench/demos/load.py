"""Read demonstrations: ours, and ManiSkill's published files of the same control mode."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, field_validator

from symsteer.bench.demos.files import SEAL, checksum, opened
from symsteer.bench.sim.trees import map_trees, rows_of
from symsteer.bench.tasks import check_embodiment, make, task_class, task_name
from symsteer.bench.tasks.embodiments import BODIES
from symsteer.errors import UserError, first_problem
from symsteer.policies.geometry import Layout

# Same joints and tool centre point as the Panda; ManiSkill records StackCube with it.
_SAME_ROBOT = {"panda_wristcam": "panda"}

# What ManiSkill's task classes use when a file does not name its robot.
_STOCK_ROBOT = "panda"

_REBUILD_BATCH = 64

DAMAGE = (
    *(OSError, KeyError, RuntimeError, TypeError, ValueError),
    *(AttributeError, MemoryError),
)
"""What h5py raises for a damaged file."""

_AGAIN = "collect or download the pair again"


class _Table(BaseModel):
    """A part of a trajectory file's .json: what is read has its type, the rest is free."""

    model_config = ConfigDict(extra="allow", strict=True)


class _Episode(_Table):
    episode_id: int
    control_mode: str | None = None
    success: bool = True

    @property
    def group(self) -> str:
        """Its name in the .h5 file."""
        return f"traj_{self.episode_id}"


class _EnvInfo(_Table):
    env_id: str
    env_kwargs: dict[str, Any]


class _Description(_Table):
    env_info: _EnvInfo
    episodes: list[_Episode]
    symsteer: dict[str, Any] = {}
    source_type: Any = "unknown"

    @property
    def embodiment(self) -> str:
        """By its name here, or that of ManiSkill's robot."""
        kwargs = self.env_info.env_kwargs
        robot = kwargs.get("robot_uids", _STOCK_ROBOT)
        robot = str(robot[0] if isinstance(robot, list) and len(robot) == 1 else robot)
        return str(kwargs.get("embodiment", _SAME_ROBOT.get(robot, robot)))

    @field_validator("episodes")
    @classmethod
    def _once(cls, episodes: list[_Episode]) -> list[_Episode]:
        if len({episode.episode_id for episode in episodes}) < len(episodes):
            raise ValueError("an episode_id occurs twice")
        return episodes


@dataclass(frozen=True)
class Demonstrations:
    """Episodes ready for imitation.

    Attributes:
        episodes: pairs of observations ``[T + 1, obs_dim]`` and actions ``[T, 7]``, float32.
        observation_layout: of the observations.
        action_layout: of the actions.
        meta: task, embodiment, mode, seed, number of episodes and steps, and where they came from.
        content_hash: SHA-256 of all observations and actions.
    """

    episodes: list[tuple[torch.Tensor, torch.Tensor]]
    observation_layout: Layout
    action_layout: Layout
    meta: dict[str, Any]
    content_hash: str

    def __len__(self) -> int:
        return len(self.episodes)


def load(
    h5_path: str | os.PathLike[str],
    task: str | None = None,
    embodiment: str | None = None,
    count: int | None = None,
) -> Demonstrations:
    """Read the first ``count`` successful episodes of a trajectory file.

    Observations stored in our layout are taken as they are; for other files (ManiSkill's) they
    are rebuilt from the stored simulation states.

    Args:
        h5_path: the ``.h5`` file; its ``.json`` lies next to it.
        task: the task that the demonstrations must be of; None: that of the file.
        embodiment: the embodiment that they must be of; None: that of the file.
        count: how many; None for all.

    Raises:
        UserError: one sentence on why the file cannot be used.
    """
    path = Path(h5_path)
    raw, description = _read_description(path)
    task = task_name(description.env_info.env_id if task is None else task)
    embodiment = description.embodiment if embodiment is None else embodiment
    env_class = task_class(task)
    check_embodiment(embodiment)
    listed = _usable(path, description, task, embodiment, count)
    layout, dim = env_class.observation_layout, env_class.action_layout.dim
    in_our_layout = description.symsteer.get("observation_layout") == layout.to_json()
    try:
        with opened(path) as file:
            groups = {
                episode.group: _read_group(path, file, episode.group, in_our_layout)
                for episode in listed
            }
            seal = file.attrs.get(SEAL)
            # Both mark a file as ours: damage to one mark must not turn the check off.
            sealed = seal is not None or "symsteer" in raw
            intact = not sealed or str(seal) == checksum(file, raw)
    except DAMAGE as error:
        raise UserError(
            f"{path} is truncated or not an HDF5 file of trajectories; download or collect it again"
        ) from error
    for name, group in groups.items():
        actions = group["actions"]
        _check(path, name, "actions", actions, (len(actions) if actions.ndim else 1, dim))
    if not in_our_layout:
        _rebuild_observations(path, groups, task, embodiment)
    digest = hashlib.sha256()
    for name, group in groups.items():
        _check(path, name, "observations", group["obs"], (len(group["actions"]) + 1, layout.dim))
        digest.update(group["obs"].tobytes())
        digest.update(group["actions"].tobytes())
    if not intact:
        raise UserError(
            f"{path} and its .json do not match the checksum that they were written with: one of "
            "them is damaged, edited, or of another pair; collect both again"
        )
    return Demonstrations(
        episodes=[
            (torch.from_numpy(group["obs"]), torch.from_numpy(group["actions"]))
            for group in groups.values()
        ],
        observation_layout=layout,
        action_layout=env_class.action_layout,
        meta={
            "task": task,
            "embodiment": embodiment,
            "mode": description.symsteer.get("mode", "external"),
            "seed": description.symsteer.get("seed"),
            "source": description.source_type,
            "episodes": len(groups),
            "steps": sum(len(group["actions"]) for group in groups.values()),
        },
        content_hash=digest.hexdigest(),
    )


def _read_description(path: Path) -> tuple[dict[str, Any], _Description]:
    """The .json file, as plain data and checked."""
    if not path.is_file():
        raise UserError(f"there is no demonstration file {path}; collect one first")
    side = path.with_suffix(".json")
    if not side.is_file():
        raise UserError(
            f"{side} is missing; ManiSkill trajectories are a pair of .h5 and .json, so copy both"
        )
    try:
        raw = json.loads(side.read_text("utf-8-sig"))
        return raw, _Description.model_validate(raw)
    except (ValueError, RecursionError) as error:
        raise UserError(
            f"{side} does not describe ManiSkill trajectories ({first_problem(error)}); {_AGAIN}"
        ) from error


def _usable(
    path: Path, description: _Description, task: str, embodiment: str, count: int | None
) -> list[_Episode]:
    """The episodes to read, after all checks that need no arrays."""
    info, kwargs = description.env_info, description.env_info.env_kwargs
    if (recorded := task_name(info.env_id)) != task:
        raise UserError(f"{path} holds demonstrations of {recorded}, but {task} is wanted")
    if (body := description.embodiment) != embodiment:
        raise UserError(f"{path} was recorded with {body!r}, but {embodiment!r} is wanted")
    wanted = BODIES[embodiment].control_mode
    modes = {str(e.control_mode or kwargs.get("control_mode")) for e in description.episodes}
    if modes - {wanted}:
        raise UserError(
            f"{path} was recorded with control mode {', '.join(sorted(modes))}, but "
            f"{wanted} is wanted; convert it with ManiSkill's replay_trajectory"
        )
    usable = [episode for episode in description.episodes if episode.success]
    least = 1 if count is None else count
    if len(usable) < least:
        raise UserError(
            f"{path} holds {len(usable)} successful episodes, but {least} are wanted; collect more"
        )
    return usable[:count]


def _read_group(path: Path, file: h5py.File, name: str, in_our_layout: bool) -> dict[str, Any]:
    """Actions, and observations or states, of one episode."""
    wanted = ["actions", "obs" if in_our_layout else "env_states"]
    if name not in file or any(key not in file[name] for key in wanted):
        raise UserError(
            f"{path} lacks {' or '.join(wanted)} of {name}, which its .json lists; {_AGAIN}"
        )
    group = file[name]
    if in_our_layout:
        return {key: np.asarray(group[key], np.float32) for key in wanted}
    states = {
        kind: {
            _SAME_ROBOT.get(key, key): np.asarray(value, np.float32)
            for key, value in group["env_states"].get(kind, {}).items()
        }
        for kind in ("actors", "articulations")
    }
    return {"actions": np.asarray(group["actions"], np.float32), "states": states}


def _check(path: Path, group: str, word: str, values: np.ndarray, shape: tuple[int, ...]) -> None:
    if values.shape != shape or len(values) == 0:
        raise UserError(
            f"{path} has {word} of shape {list(values.shape)} in {group}, but {list(shape)} is "
            "wanted; it is damaged, or was recorded with another control mode or version of "
            "ManiSkill: record it again"
        )
    if not np.isfinite(values).all():
        raise UserError(f"{path} has NaN or infinite {word} in {group}; record it again")


def _rebuild_observations(
    path: Path, groups: dict[str, dict[str, Any]], task: str, embodiment: str
) -> None:
    """Put stored states into a simulation and observe them in our layout."""
    env = make(task, num_envs=_REBUILD_BATCH, embodiment=embodiment)
    template = env.get_state_dict()
    for name, group in groups.items():
        total = len(group["actions"]) + 1
        states: dict[str, dict[str, np.ndarray]] = {"actors": {}, "articulations": {}}
        for kind, bodies in states.items():
            for body, value in template[kind].items():
                stored = group["states"][kind].get(body, np.empty(0))
                _check(path, name, f"states of {body!r}", stored, (total, value.shape[1]))
                bodies[body] = stored
        seen = []
        for start in range(0, total, _REBUILD_BATCH):
            # The last batch is filled up with the last state.
            index = np.arange(start, start + _REBUILD_BATCH).clip(max=total - 1)
            env.set_state_dict(map_trees(torch.from_numpy, rows_of(states, index)))
            seen.append(env.get_obs().cpu().numpy()[: total - start].copy())
        group["obs"] = np.concatenate(seen)
    env.close()
