"""What gymnasium and ManiSkill's wrappers expect of an environment beyond ManiSkill's own."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium as gym
import numpy as np
import torch
from gymnasium.envs.registration import EnvSpec
from mani_skill.envs.sapien_env import BaseEnv

from symsteer.bench.sim import rendering_works
from symsteer.errors import UserError


class GymEnv(BaseEnv):
    """A ManiSkill environment as gymnasium's checker and ``CPUGymWrapper`` expect it.

    ManiSkill reads ``gpu_sim_enabled`` for two purposes. Its own methods use it to choose the
    batched branch, which is the one that runs here, on any device. Wrappers conclude from it that
    tensors live on a GPU: ``CPUGymWrapper`` refuses such an environment. So it is true while
    ManiSkill's methods run; at other times it is false for one environment on the CPU.
    """

    _batched_branch = False

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        # ManiSkill's belongs to the class and lists modes that this machine may lack.
        self.metadata = {
            "render_modes": [mode for mode in self.SUPPORTED_RENDER_MODES if _renders(mode)],
            "render_fps": self.control_freq,
        }

    @property
    def gpu_sim_enabled(self) -> bool:
        """Whether ManiSkill's batched branch is used, as the caller sees it."""
        one_on_cpu = self.num_envs == 1 and self.device.type == "cpu"
        return self.scene.gpu_sim_enabled and (self._batched_branch or not one_on_cpu)

    @contextmanager
    def _in_batched_branch(self) -> Iterator[None]:
        before, self._batched_branch = self._batched_branch, True
        try:
            yield
        finally:
            self._batched_branch = before

    def reset(self, seed: Any = None, options: dict | None = None) -> tuple:
        """As ManiSkill's; a seed also seeds ``np_random``, as gymnasium requires."""
        if seed is not None:
            gym.Env.reset(self, seed=int(np.atleast_1d(seed)[0]))
        with self._in_batched_branch():
            return super().reset(seed=seed, options=options)

    def step(self, action: Any) -> tuple:
        """As ManiSkill's; actions may be integers too.

        Raises:
            UserError: if the action is a list.
        """
        if isinstance(action, list | tuple):
            raise UserError(
                f"an action is a tensor or array of shape {self.action_space.shape}, not a "
                f"{type(action).__name__}"
            )
        if isinstance(action, np.ndarray) and action.dtype.kind in "biu":
            action = action.astype(np.float32)
        elif torch.is_tensor(action) and not action.is_floating_point():
            action = action.float()
        return super().step(action)

    def get_info(self) -> dict:
        """As ManiSkill's."""
        with self._in_batched_branch():
            return super().get_info()

    def set_state_dict(self, state: dict, env_idx: torch.Tensor | None = None) -> None:
        """As ManiSkill's."""
        with self._in_batched_branch():
            super().set_state_dict(state, env_idx)

    def render_human(self) -> Any:
        """As ManiSkill's."""
        with self._in_batched_branch():
            return super().render_human()

    def _step_action(self, action: Any) -> Any:
        with self._in_batched_branch():
            return super()._step_action(action)


class EpisodeLimit(gym.Wrapper, gym.utils.RecordConstructorArgs):
    """gymnasium's ``TimeLimit`` for batched environments: each counts its own steps.

    Replaces the ``TimeLimit`` that ``gym.make`` put around the environment and takes over its
    limit, so that ``gym.make(..., max_episode_steps=100)`` works. Without one (gymnasium's
    ``max_episode_steps=-1``) nothing is truncated.
    """

    def __init__(self, env: gym.Env) -> None:
        gym.utils.RecordConstructorArgs.__init__(self)
        self.max_episode_steps: int | None = None
        if isinstance(env, gym.wrappers.TimeLimit):
            self.max_episode_steps = env._max_episode_steps
            env = env.env
        gym.Wrapper.__init__(self, env)

    @property
    def spec(self) -> EnvSpec | None:  # type: ignore[override]
        """What ``gym.make`` needs to make this environment again, limit included."""
        spec = super().spec
        if spec is not None:
            spec.max_episode_steps = self.max_episode_steps
            strength: Any = spec.kwargs.get("strength")
            if hasattr(strength, "tolist"):
                spec.kwargs["strength"] = strength.tolist()  # JSON has no tensors
        return spec

    def __getattr__(self, name: str) -> Any:
        """What ManiSkill's wrapper for Stable-Baselines3 reads of the environment."""
        if name in ("num_envs", "single_observation_space", "single_action_space"):
            return getattr(self.env, name)
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")

    def step(self, action: Any) -> tuple:
        """As the environment's; ``truncated`` ``[N]`` depends on the limit only."""
        obs, reward, terminated, truncated, info = self.env.step(action)
        if self.max_episode_steps is None:
            truncated = truncated & False
        else:
            truncated = self.get_wrapper_attr("elapsed_steps") >= self.max_episode_steps
        return obs, reward, terminated, truncated, info


def _renders(mode: str) -> bool:
    """Whether a render mode works on this machine: all need a GPU driver, one a display too."""
    return rendering_works() and (mode != "human" or "DISPLAY" in os.environ)
