"""Pictures of demonstrations: their stored states, rendered one after the other."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import torch
from tqdm import tqdm

from symsteer.bench.demos.files import opened
from symsteer.bench.runs.film import CAMERA, write_video
from symsteer.bench.sim.trees import map_trees, rows_of
from symsteer.bench.tasks import make

PIXELS = 128
"""Width and height of the pictures."""

RENDERING: dict[str, Any] = {
    "render": True,
    "render_mode": "rgb_array",
    "human_render_camera_configs": {**CAMERA, "fov": 0.65, "width": PIXELS, "height": PIXELS},
}
"""Options of :func:`symsteer.make` for environments whose ``render()`` gives these pictures."""

CODEC = "h264"
ENCODING = ("-g", "2", "-bf", "0", "-crf", "20")
"""A key frame in every second frame and none that depends on later ones: readers jump about."""

STRIDE = 4
"""Statistics use every fourth row and column of a picture."""


def film_demonstrations(
    demonstrations: Path, task: str, embodiment: str, lengths: list[int], out: Path
) -> list[np.ndarray]:
    """Write one video of all episodes: a frame for each action, of the state before it.

    Args:
        demonstrations: the .h5 file.
        task, embodiment: of the demonstrations.
        lengths: actions of each episode.
        out: the .mp4 file.

    Returns:
        A part of the pixels of each episode, ``[T, height, width, 3]`` uint8.

    Raises:
        UserError: if there is no Vulkan driver, or the file cannot be written.
    """
    pixels: list[list[np.ndarray]] = [[] for _ in lengths]

    def frames() -> Iterator[np.ndarray]:
        env = make(task, num_envs=1, embodiment=embodiment, **RENDERING)
        with (
            contextlib.closing(env),
            opened(demonstrations) as file,
            tqdm(total=sum(lengths), desc="video", disable=None) as bar,
        ):
            env.reset(seed=0)
            for episode, length in enumerate(lengths):
                states = _arrays(file[f"traj_{episode}/env_states"])
                for step in range(length):
                    row = rows_of(states, slice(step, step + 1))
                    env.set_state_dict(map_trees(torch.from_numpy, row))
                    frame = env.render()[0].cpu().numpy()[..., :3]
                    pixels[episode].append(frame[::STRIDE, ::STRIDE])
                    yield frame
                    bar.update()

    write_video(out, frames(), ENCODING)
    return [np.stack(frames) for frames in pixels]


def _arrays(group: h5py.Group) -> dict[str, Any]:
    return {
        key: _arrays(value) if isinstance(value, h5py.Group) else np.asarray(value)
        for key, value in group.items()
    }
