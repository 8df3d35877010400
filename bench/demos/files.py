"""The files of demonstrations: ManiSkill's trajectories, with a checksum of our own."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np

from symsteer.bench.tasks import gym_id
from symsteer.errors import UserError
from symsteer.files import write_together
from symsteer.variant import UNBROKEN

if TYPE_CHECKING:
    from symsteer.bench.tasks.base import SymmetricTask

FORMAT = 2
"""Version of our files; 2 has a checksum."""

SEAL = "sha256"
"""Attribute of the .h5 file that holds the checksum."""

LARGEST, MOST_COMPRESSED = 2**30, 20
"""Bytes that every file may unpack to; a larger one to so many times its size."""


@dataclass(frozen=True)
class Episode:
    """One successful episode of the expert, arrays over time: T actions, T + 1 states."""

    seed: int
    obs: np.ndarray
    actions: np.ndarray
    rewards: np.ndarray
    states: dict[str, Any]


def write(path: Path, env: SymmetricTask, episodes: list[Episode], origin: dict[str, Any]) -> None:
    """Write episodes as a pair of .h5 and .json.

    Args:
        path: the .h5 file.
        env: where they were recorded.
        episodes: what is written.
        origin: how they were collected, as plain data; ``mode`` is the name of their kind.

    Raises:
        UserError: if the files cannot be written; earlier ones stay as they were.
    """
    description = {
        "env_info": {
            "env_id": gym_id(env.task_id),
            "env_kwargs": {
                "obs_mode": "state",
                "control_mode": env.control_mode,
                "embodiment": env.embodiment,
                "variant": UNBROKEN,
                "reward_mode": env.reward_mode,
                "sim_backend": "physx_cpu",
                "num_envs": 1,
            },
            "max_episode_steps": env.max_episode_steps,
        },
        "episodes": [
            {
                "episode_id": i,
                "episode_seed": episode.seed,
                "control_mode": env.control_mode,
                "elapsed_steps": len(episode.actions),
                "reset_kwargs": {"seed": episode.seed},
                "success": True,
            }
            for i, episode in enumerate(episodes)
        ],
        "source_type": "scripted",
        "source_desc": f"SymSteer's scripted expert, {origin['mode']} demonstrations",
        "symsteer": {
            "format": FORMAT,
            **origin,
            "observation_layout": env.observation_layout.to_json(),
            "action_layout": env.action_layout.to_json(),
        },
    }
    # In memory first: on a full disk HDF5 would leave a damaged file.
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for i, episode in enumerate(episodes):
            group = file.create_group(f"traj_{i}", track_order=True)
            end = len(episode.actions)
            last = np.arange(end) == end - 1
            group.create_dataset("obs", data=episode.obs, dtype=np.float32)
            group.create_dataset("actions", data=episode.actions, dtype=np.float32)
            group.create_dataset("terminated", data=last)
            group.create_dataset("truncated", data=last & (end >= env.max_episode_steps))
            group.create_dataset("success", data=last)
            group.create_dataset("rewards", data=episode.rewards, dtype=np.float32)
            _write_tree(group.create_group("env_states", track_order=True), episode.states)
        file.attrs[SEAL] = checksum(file, description)
    text = json.dumps(description, indent=2) + "\n"
    write_together({path.with_suffix(".json"): text.encode(), path: buffer.getvalue()})


def _write_tree(group: h5py.Group, tree: dict[str, Any]) -> None:
    for key, value in tree.items():
        if isinstance(value, dict):
            _write_tree(group.create_group(key, track_order=True), value)
        else:
            group.create_dataset(key, data=value, dtype=np.float32)


@contextlib.contextmanager
def opened(path: Path) -> Iterator[h5py.File]:
    """A trajectory file that is to be read, if all of its data are its own.

    HDF5 opens other files by itself for external links, external storage and virtual datasets, so a
    stranger's file could contain any file of its reader.

    Raises:
        UserError: if data lie elsewhere, or are much larger than the file.
        OSError, RuntimeError, ...: as h5py, for a damaged file.
    """
    foreign: list[str] = []
    sizes = [0]

    def look(name: str, item: Any) -> None:
        if isinstance(item, h5py.Group):
            links = {key: item.get(key, getlink=True) for key in item}
            foreign.extend(k for k, link in links.items() if isinstance(link, h5py.ExternalLink))
        elif isinstance(item, h5py.Dataset):
            sizes.append(item.nbytes)
            if item.is_virtual or item.external:
                foreign.append(name)

    with h5py.File(path, "r") as file:
        look("/", file)
        file.visititems(look)
        if foreign:
            raise UserError(
                f"{path} takes {foreign[0]!r} from another file, so reading it could disclose any "
                "file of yours; do not use it, or copy the data into it"
            )
        if sum(sizes) > max(LARGEST, MOST_COMPRESSED * os.path.getsize(path)):
            raise UserError(
                f"{path} unpacks to {sum(sizes) / 2**30:.1f} GiB, far more than it has bytes; do "
                "not use it"
            )
        yield file


def checksum(file: h5py.File, description: dict[str, Any]) -> str:
    """SHA-256 of every array of the .h5 file and of the content of its .json."""
    digest = hashlib.sha256(json.dumps(description, sort_keys=True).encode())

    def add(name: str, item: h5py.Group | h5py.Dataset) -> None:
        if isinstance(item, h5py.Dataset):
            array = np.asarray(item)
            digest.update(f"{name} {array.dtype} {array.shape}".encode())
            digest.update(array.tobytes())

    file.visititems(add)
    return digest.hexdigest()
