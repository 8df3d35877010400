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


class _Table(BaseModel):
    """A part of a trajectory file's .json: what is read has its type, the rest is kept."""

    model_config = ConfigDict(extra="allow", strict=True)


class _Episode(_Table):
    episode_id: int
    control_mode: str | None = None
    success: bool = True


class _EnvInfo(_Table):
    env_id: str
    env_kwargs: dict[str, Any]


class _Description(_Table):
    env_info: _EnvInfo
    episodes: list[_Episode]
    symsteer: dict[str, Any] = {}

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
        meta: task, embodiment, variant, mode, number of episodes and where they came from.
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
    h5_path: str | os.PathLike[str], task: str, embodiment: str, count: int | None = None
) -> Demonstrations:
    """Read the first ``count`` successful episodes of a trajectory file.

    Observations stored in our layout are taken as they are; for other files (ManiSkill's) they
    are rebuilt from the stored simulation states.

    Args:
        h5_path: the ``.h5`` file; its ``.json`` lies next to it.
        task: the task that the demonstrations must be of.
        embodiment: the embodiment that they must be of.
        count: how many; None for all.

    Raises:
        UserError: one sentence on why the file cannot be used.
    """
    path = Path(h5_path)
    task, env_class = task_name(task), task_class(task)
    check_embodiment(embodiment)
    description = _read_description(path)
    records = _usable_records(path, description, task, embodiment, count)
    layout = env_class.observation_layout
    own = description.get("symsteer", {}).get("observation_layout") == layout.to_json()
    try:
        with opened(path) as file:
            groups = [_read_group(path, file, record, own) for record in records]
            seal = file.attrs.get(SEAL)
            # Both mark a file as ours: damage to one mark must not turn the check off.
            sealed = seal is not None or "symsteer" in description
            intact = not sealed or str(seal) == checksum(file, description)
    # HDF5 reports damage by many kinds of errors.
    except (OSError, KeyError, RuntimeError, TypeError, ValueError, MemoryError) as error:
        raise UserError(
            f"{path} is truncated or not an HDF5 file of trajectories; download or collect it again"
        ) from error
    for group in groups:
        _check_actions(path, group, env_class.action_layout.dim)
    if not own:
        _rebuild_observations(path, groups, task, embodiment)
    for group in groups:
        _check_observations(path, group, layout.dim)
    if not intact:
        raise UserError(
            f"{path} and its .json do not match the checksum that they were written with: one of "
            "them is damaged, edited, or of another pair; collect both again"
        )
    episodes = [(torch.from_numpy(g["obs"]), torch.from_numpy(g["actions"])) for g in groups]
    digest = hashlib.sha256()
    for obs, actions in episodes:
        digest.update(obs.numpy().tobytes())
        digest.update(actions.numpy().tobytes())
    kwargs = description["env_info"]["env_kwargs"]
    return Demonstrations(
        episodes=episodes,
        observation_layout=layout,
        action_layout=env_class.action_layout,
        meta={
            "task": task,
            "embodiment": embodiment,
            "variant": kwargs.get("variant", "none"),
            "mode": description.get("symsteer", {}).get("mode", "external"),
            "source": description.get("source_type", "unknown"),
            "episodes": len(episodes),
            "steps": sum(len(actions) for _, actions in episodes),
        },
        content_hash=digest.hexdigest(),
    )


def _read_description(path: Path) -> dict[str, Any]:
    if not path.is_file():
        raise UserError(f"there is no demonstration file {path}; collect one first")
    side = path.with_suffix(".json")
    if not side.is_file():
        raise UserError(
            f"{side} is missing; ManiSkill trajectories are a pair of .h5 and .json, so copy both"
        )
    try:
        description = json.loads(side.read_text("utf-8-sig"))
        return _Description.model_validate(description).model_dump(exclude_unset=True)
    except (ValueError, RecursionError) as error:
        raise UserError(
            f"{side} does not describe ManiSkill trajectories ({first_problem(error)}); "
            "collect or download the pair again"
        ) from error


def _usable_records(
    path: Path, description: dict[str, Any], task: str, embodiment: str, count: int | None
) -> list[dict[str, Any]]:
    """The JSON records of the episodes to read, after all checks that need no arrays."""
    info = description["env_info"]
    found = task_name(str(info["env_id"]))
    if found != task:
        raise UserError(f"{path} holds demonstrations of {found}, but {task} is wanted")
    kwargs = info["env_kwargs"]
    body = BODIES[embodiment]
    robot = kwargs.get("robot_uids", _STOCK_ROBOT)
    robot = robot[0] if isinstance(robot, list) and len(robot) == 1 else robot
    found = kwargs.get("embodiment", _SAME_ROBOT.get(str(robot), str(robot)))
    if found != embodiment:
        raise UserError(f"{path} was recorded with {found!r}, but {embodiment!r} is wanted")
    records = description["episodes"]
    modes = {str(r.get("control_mode", kwargs.get("control_mode"))) for r in records}
    if modes - {body.control_mode}:
        raise UserError(
            f"{path} was recorded with control mode {', '.join(sorted(modes))}, but "
            f"{body.control_mode} is wanted; convert it with ManiSkill's replay_trajectory"
        )
    usable = [r for r in records if r.get("success", True)]
    if len(usable) < (1 if count is None else count):
        raise UserError(
            f"{path} holds {len(usable)} successful episodes, but "
            f"{'at least 1' if count is None else count} are wanted; collect more"
        )
    return usable[:count]


def _read_group(path: Path, file: h5py.File, record: dict[str, Any], own: bool) -> dict[str, Any]:
    """Actions, and observations or states, of one episode."""
    name = f"traj_{record['episode_id']}"
    wanted = ["actions", "obs" if own else "env_states"]
    if name not in file or any(key not in file[name] for key in wanted):
        raise UserError(
            f"{path} lacks {' or '.join(wanted)} of {name}, which its .json lists; "
            "collect or download the pair again"
        )
    group = file[name]
    read: dict[str, Any] = {"name": name, "actions": np.asarray(group["actions"], np.float32)}
    if own:
        read["obs"] = np.asarray(group["obs"], np.float32)
    else:
        read["states"] = {
            kind: {key: np.asarray(value, np.float32) for key, value in group[path_].items()}
            for kind in ("actors", "articulations")
            if (path_ := f"env_states/{kind}") in group
        }
    return read


def _check_actions(path: Path, group: dict[str, Any], dim: int) -> None:
    actions = group["actions"]
    if actions.ndim != 2 or actions.shape[1] != dim:
        raise UserError(
            f"{path} has actions of shape {list(actions.shape)} in {group['name']}, but "
            f"[steps, {dim}] is wanted; it was recorded with another control mode"
        )
    if len(actions) == 0:
        raise UserError(f"{path} has no steps in {group['name']}; collect it again")
    if not np.isfinite(actions).all():
        raise UserError(f"{path} has NaN or infinite actions in {group['name']}; collect it again")


def _check_observations(path: Path, group: dict[str, Any], dim: int) -> None:
    obs, steps = group["obs"], len(group["actions"])
    if obs.shape != (steps + 1, dim):
        raise UserError(
            f"{path} has observations of shape {list(obs.shape)} in {group['name']}, but "
            f"[{steps + 1}, {dim}] is wanted; collect it again"
        )
    if not np.isfinite(obs).all():
        raise UserError(
            f"{path} has NaN or infinite observations in {group['name']}; collect it again"
        )


def _rebuild_observations(
    path: Path, groups: list[dict[str, Any]], task: str, embodiment: str
) -> None:
    """Put stored states into a simulation and observe them in our layout."""
    env = make(task, num_envs=_REBUILD_BATCH, embodiment=embodiment)
    template = env.get_state_dict()
    for group in groups:
        states = _matched(path, group, template)
        total = len(group["actions"]) + 1
        rows = []
        for start in range(0, total, _REBUILD_BATCH):
            # The last batch is filled up with the last state.
            index = np.arange(start, start + _REBUILD_BATCH).clip(max=total - 1)
            env.set_state_dict(map_trees(torch.from_numpy, rows_of(states, index)))
            rows.append(env.get_obs().cpu().numpy()[: total - start].copy())
        group["obs"] = np.concatenate(rows)
    env.close()


def _matched(
    path: Path, group: dict[str, Any], template: dict[str, Any]
) -> dict[str, dict[str, np.ndarray]]:
    """The stored states under this simulation's names, shapes checked."""
    total = len(group["actions"]) + 1
    matched: dict[str, dict[str, np.ndarray]] = {}
    for kind in ("actors", "articulations"):
        stored = {
            _SAME_ROBOT.get(key, key): value for key, value in group["states"].get(kind, {}).items()
        }
        matched[kind] = {}
        for key, value in template[kind].items():
            if key not in stored or stored[key].shape != (total, value.shape[1]):
                raise UserError(
                    f"{path} has no states of {key!r} with shape [{total}, {value.shape[1]}] in "
                    f"{group['name']}; record it again with this version of ManiSkill"
                )
            if not np.isfinite(stored[key]).all():
                raise UserError(
                    f"{path} has NaN or infinite states in {group['name']}; record it again"
                )
            matched[kind][key] = stored[key]
    return matched
