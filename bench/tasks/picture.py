"""``python -m bench.tasks.picture docs/tasks.png``: all tasks, both embodiments, in one picture.

Needs a Vulkan driver; ``symsteer doctor`` says whether there is one.
"""

from __future__ import annotations

import sys
from pathlib import Path

import imageio.v3 as imageio
import numpy as np

from bench.tasks import embodiments, make, task_names
from bench.tasks.experts import Expert
from policies.errors import UserError

SIZE = 320
CAMERA = {"width": SIZE, "height": SIZE}


def snapshot(task: str, embodiment: str, seed: int, steps: int) -> np.ndarray:
    """A frame ``[SIZE, SIZE, 3]`` uint8 of the scripted expert after ``steps`` control steps."""
    env = make(
        task,
        num_envs=1,
        embodiment=embodiment,
        render=True,
        render_mode="rgb_array",
        human_render_camera_configs=CAMERA,
    )
    env.reset(seed=[seed])
    expert = Expert(env)
    for _ in range(steps):
        env.step(expert.act())
    frame = env.render()[0].cpu().numpy()[..., :3]
    env.close()
    return frame


def contact_sheet(seed: int = 1, steps: int = 5) -> np.ndarray:
    """Tasks from left to right, embodiments from top to bottom, uint8."""
    rows = [
        np.concatenate(
            [snapshot(task, embodiment, seed, steps)[SIZE * 3 // 10 :] for task in task_names()],
            axis=1,
        )
        for embodiment in embodiments()
    ]
    return np.concatenate(rows, axis=0)


def main() -> int:
    """Write the picture to the path given on the command line."""
    if len(sys.argv) != 2:
        print("usage: python -m bench.tasks.picture FILE.png", file=sys.stderr)
        return 2
    try:
        imageio.imwrite(Path(sys.argv[1]), contact_sheet())
    except (UserError, OSError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
