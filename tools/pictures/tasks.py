"""Pictures of the tasks, with both embodiments, for the documentation.

- ``python -m tools.pictures.tasks docs/tasks.png``: all tasks in one picture, but for
  those on a tilted table and those that cameras see, whose scenes are the same.
- ``python -m tools.pictures.tasks docs/tasks/pull-cube.png PullCube-v1``: one task.
- ``... docs/tasks/seen-push-cube.png SeenPushCube-v1``: what the cameras see, and the cloud.
- ``... docs/seen.png HeightPushCube-v1 HandPushCube-v1 SeenPushCube-v1``: what is seen in the
  worlds of docs/seen.md, a row for each task.

Needs a Vulkan driver; ``symsteer doctor`` says whether there is one.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import sapien
import torch
from PIL import Image, ImageDraw

from symsteer.bench.runs.film import CAMERA, SIZE, captioned
from symsteer.bench.tasks import EMBODIMENTS, TASKS, make, task_class
from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.tasks.clouds import CAMERAS, PIXELS
from symsteer.bench.tasks.experts import Expert
from symsteer.bench.tasks.heights import Above
from symsteer.bench.tasks.in_hand import InHand
from symsteer.bench.tasks.tilted import Tilted
from symsteer.errors import UserError
from symsteer.files import staged
from symsteer.terminal import complain

TASKS_PER_ROW = 4
COLOURS = 128
VIEW = 192
"""Width and height of a camera's picture and of a view of a cloud, pixels."""
SHOWN = 0.2
"""Half of the width of what a view of a cloud shows, and the height that is white, metres."""
DEEP = 0.25
"""Distance from a camera in the hand that is almost black, metres."""
WORLDS = ("none", "perception_bias:1", "camera_rotation:1")
"""In which the cameras see differently; ``worlds_picture`` takes one more."""


def snapshot(task: str, embodiment: str, seed: int, steps: int) -> np.ndarray:
    """A frame ``[SIZE, SIZE, 3]`` uint8 of the scripted expert after ``steps`` control steps."""
    env = make(
        task,
        num_envs=1,
        embodiment=embodiment,
        render=True,
        render_mode="rgb_array",
        human_render_camera_configs={**CAMERA, "pose": _camera_pose(task, seed)},
    )
    env.reset(seed=[seed])
    expert = Expert(env)
    for _ in range(steps):
        env.step(expert.act())
    frame = env.render()[0].cpu().numpy()[..., :3]
    env.close()
    return frame


def _camera_pose(task: str, seed: int) -> sapien.Pose:
    """Where a camera that is level in the laboratory is in the world of the bodies."""
    pose = CAMERA["pose"].sp
    if not issubclass(task_class(task), Tilted):
        return pose
    env = make(task, num_envs=1)
    env.reset(seed=[seed])
    frame = sapien.Pose(q=env.frame[0].cpu().numpy())
    env.close()
    return frame.inv() * pose


def task_picture(task: str, axis: int = 1, seed: int = 1, steps: int = 8) -> np.ndarray:
    """One task with all embodiments, along ``axis`` (0: in a column, 1: side by side), uint8."""
    frames = [
        captioned(snapshot(task, e, seed, steps)[SIZE // 5 :], f"{task.removesuffix('-v1')}, {e}")
        for e in EMBODIMENTS
    ]
    return np.concatenate(frames, axis=axis)


def seen_picture(task: str, seed: int = 1, steps: int = 8) -> np.ndarray:
    """The heights that the cameras of a task see, and its cloud from above and from the side."""
    env = make(task, num_envs=1)
    env.reset(seed=[seed])
    expert = Expert(env)
    for _ in range(steps):
        env.step(expert.act())
    cloud, heights = env.cloud()[0].numpy(), env.look()[0][0, :, 2].view(CAMERAS, PIXELS, PIXELS)
    env.close()
    grey = (40 + 215 * (heights / SHOWN).clamp(0, 1)).byte().numpy()
    parts = []
    for k, picture in enumerate(grey):
        large = Image.fromarray(picture).resize((VIEW, VIEW), Image.Resampling.NEAREST)
        parts.append(captioned(np.asarray(large.convert("RGB")), f"camera {k + 1}: height"))
    parts.append(captioned(_view(cloud[:, :2]), f"{len(cloud)} points, from above"))
    parts.append(captioned(_view(cloud[:, [0, 2]] - [0, 0.75 * SHOWN]), "from the side"))
    return np.concatenate(parts, axis=1)


def worlds_picture(task: str, world: str, seed: int = 1, steps: int = 8) -> np.ndarray:
    """What is seen of a state, in `WORLDS` and one more, uint8; what is near is light."""
    parts = []
    for variant in (*WORLDS, world):
        env = make(task, num_envs=1, variant=variant)
        env.reset(seed=[seed])
        expert = Expert(env)
        for _ in range(steps):
            env.step(expert.act())
        parts.append(captioned(_seen(env), variant))
        env.close()
    return np.concatenate(parts, axis=1)


def _seen(env: SymmetricTask) -> np.ndarray:
    if cloud := env.observation_layout.cloud:
        return _view(env.get_obs()[0, cloud.columns][:, :2].numpy())
    if isinstance(env, InHand):
        distance = env.distances()[0]
        light = torch.where(distance > 0, (1.2 - distance / DEEP).clamp(0.2, 1), 0)
    else:
        assert isinstance(env, Above)
        # The root shows low things, too.
        light = (env.heights()[0] / SHOWN).clamp(0, 1).sqrt()
    grey = Image.fromarray((255 * light).byte().numpy())
    return np.asarray(grey.resize((VIEW, VIEW), Image.Resampling.NEAREST).convert("RGB"))


def _view(places: np.ndarray) -> np.ndarray:
    """Points ``[P, 2]`` metres, to the right and upwards, uint8."""
    picture = Image.new("RGB", (VIEW, VIEW), "white")
    draw = ImageDraw.Draw(picture)
    for x, y in VIEW / 2 * (1 + places / SHOWN * [1, -1]):
        draw.ellipse((x - 2, y - 2, x + 2, y + 2), fill="#1f5fa8")
    draw.rectangle((0, 0, VIEW - 1, VIEW - 1), outline="#999999")
    return np.asarray(picture)


def contact_sheet() -> np.ndarray:
    """Tasks in rows; each with its embodiments from top to bottom; uint8."""
    known = [(task, task_class(task)) for task in TASKS]
    flat = [task for task, cls in known if not (issubclass(cls, Tilted) or cls.is_seen())]
    pictures = [task_picture(task, axis=0) for task in flat]
    blank = [np.full_like(pictures[0], 255)] * (-len(pictures) % TASKS_PER_ROW)
    pictures += blank
    rows = [
        np.concatenate(pictures[i : i + TASKS_PER_ROW], axis=1)
        for i in range(0, len(pictures), TASKS_PER_ROW)
    ]
    return np.concatenate(rows, axis=0)


def picture_of(tasks: Sequence[str]) -> np.ndarray:
    """What the command line asks for, uint8."""
    if not tasks:
        return contact_sheet()
    if len(tasks) > 1:
        for task in tasks:
            if not task_class(task).is_seen():
                raise UserError(f"no camera sees {task}: name one task, or tasks that cameras see")
        return np.concatenate([worlds_picture(task, "actuator_offset:0.5") for task in tasks])
    (task,) = tasks
    kind = task_class(task)
    if kind.observation_layout.picture:
        return worlds_picture(task, "obstacle:1")
    return (seen_picture if kind.is_seen() else task_picture)(task)


def main() -> int:
    """Write the picture to the path given on the command line."""
    if len(sys.argv) < 2:
        print("usage: python -m tools.pictures.tasks FILE.png [TASK ...]", file=sys.stderr)
        return 2
    try:
        picture = picture_of(sys.argv[2:])
        # The texture of the table would take most of the bytes.
        small = Image.fromarray(picture).quantize(COLOURS, dither=Image.Dither.NONE)
        with staged(Path(sys.argv[1])) as file:
            small.save(file, "PNG", optimize=True)
    except (UserError, OSError, ValueError) as error:
        return complain(error, f"error: {error}", 2)
    return 0


if __name__ == "__main__":
    sys.exit(main())
