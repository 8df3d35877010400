"""A SymSteer task as LeRobot's environment hub (EnvHub) loads it.

Observations are LeRobot's: ``agent_pos`` is the gripper, ``environment_state`` what is observed of
the objects, ``pixels`` a picture if ``IMAGES`` is set. They are those of the datasets that
``symsteer export-lerobot`` writes.
"""

from __future__ import annotations

import functools
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv

from symsteer.bench import RENDERING, rendering_works, tasks
from symsteer.policies import Layout

TASK = "PickCube-v1"
EMBODIMENT = "floating"
VARIANT = "none"
"""How the symmetry is broken, e.g. ``action_gain:0.5``."""
IMAGES = False
"""Pictures need a Vulkan driver."""


class LeRobotEnv(gym.Wrapper):
    """One environment with the observations and attributes that LeRobot's evaluation uses.

    Args:
        task: name of a task.
        images: whether to add pictures to the observations.
    """

    def __init__(self, task: str, images: bool = IMAGES):
        name = f"{tasks.NAMESPACE}{task.replace('-v', '-single-v')}"
        options = RENDERING if images or rendering_works() else {}
        super().__init__(gym.make(name, embodiment=EMBODIMENT, variant=VARIANT, **options))
        self.task, self.task_description = task, tasks.TASKS.summary(task)
        self._max_episode_steps = self.env.get_wrapper_attr("spec").max_episode_steps
        self.images = images
        width = self.env.observation_space.shape[0]
        self.gripper = Layout(tasks.task_class(task).gripper_fields).dim
        parts = {
            "agent_pos": spaces.Box(-np.inf, np.inf, (self.gripper,)),
            "environment_state": spaces.Box(-np.inf, np.inf, (width - self.gripper,)),
        }
        if images:
            size = RENDERING["human_render_camera_configs"]["width"]
            parts["pixels"] = spaces.Box(0, 255, (size, size, 3), np.uint8)
        self.observation_space = spaces.Dict(parts)

    def reset(self, **options: Any) -> tuple[dict[str, np.ndarray], dict]:
        """As gymnasium's."""
        obs, info = self.env.reset(**options)
        return self._observed(obs), info

    def step(self, action: np.ndarray) -> tuple:
        """As gymnasium's; ``info["is_success"]`` is LeRobot's name of success."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        info["is_success"] = bool(info["success"])
        return self._observed(obs), reward, terminated, truncated, info

    def _observed(self, obs: np.ndarray) -> dict[str, np.ndarray]:
        observed = {
            "agent_pos": obs[: self.gripper],
            "environment_state": obs[self.gripper :],
        }
        return observed | ({"pixels": self.env.render()} if self.images else {})


def make_env(
    n_envs: int = 1, use_async_envs: bool = False, cfg: Any = None
) -> dict[str, dict[int, VectorEnv]]:
    """The function that LeRobot calls.

    Args:
        n_envs: how many environments.
        use_async_envs: one process for each, instead of one for all.
        cfg: LeRobot's configuration; its ``task``, if there is one, replaces ``TASK``.

    Returns:
        The vector environment, under the task's name and the number 0.
    """
    task = getattr(cfg, "task", None) or TASK
    kind = AsyncVectorEnv if use_async_envs else SyncVectorEnv
    one = functools.partial(LeRobotEnv, task)
    return {task: {0: kind([one] * n_envs, autoreset_mode=AutoresetMode.SAME_STEP)}}
