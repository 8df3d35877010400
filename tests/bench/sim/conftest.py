"""Environments for the simulation tests: ours over N scenes, and ManiSkill's own for one."""

from __future__ import annotations

from typing import Any, ClassVar

import pytest
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.structs.pose import Pose

from symsteer.bench.sim import create, prepare_headless
from tests.bench.state_tasks import STATE_TASKS
from tools.speed.simulation import stock_class


class Kit:
    """What the tests share."""

    tasks: ClassVar[dict[str, type[BaseEnv]]] = {
        name.removesuffix("-v1"): stock_class(name)
        for name in STATE_TASKS
        if not name.startswith("Tilted")
    }
    robots: ClassVar[dict[str, str]] = {"PushT": "panda_stick"}
    settings: ClassVar[dict[str, Any]] = {
        "obs_mode": "state",
        "control_mode": "pd_joint_delta_pos",
        "reward_mode": "dense",
    }

    def _settings(self, task: str, settings: dict[str, Any]) -> dict[str, Any]:
        return {"robot_uids": self.robots.get(task, "panda"), **self.settings, **settings}

    def batched(self, task: str, num_envs: int, **settings: Any) -> BaseEnv:
        """A task on our batched CPU physics."""
        return create(self.tasks[task], num_envs, **self._settings(task, settings))

    def stock(self, task: str, **settings: Any) -> BaseEnv:
        """The same task on ManiSkill's own CPU physics, which allows one environment."""
        prepare_headless()
        kwargs = self._settings(task, settings)
        return self.tasks[task](sim_backend="physx_cpu", render_backend="none", **kwargs)

    @staticmethod
    def actions(env: BaseEnv, steps: int, seed: int = 0) -> torch.Tensor:
        """Random actions [steps, num_envs, dim], uniform in [-1, 1]."""
        generator = torch.Generator().manual_seed(seed)
        dim = env.single_action_space.shape[0]
        return torch.rand(steps, env.num_envs, dim, generator=generator) * 2 - 1

    @classmethod
    def rows(cls, state: Any, i: int) -> Any:
        """The state of environment i alone, still with a batch dimension."""
        if isinstance(state, dict):
            return {key: cls.rows(value, i) for key, value in state.items()}
        return state[i : i + 1].clone()

    @classmethod
    def flat(cls, state: Any) -> torch.Tensor:
        """A state dictionary as one tensor [N, ...]."""
        if isinstance(state, dict):
            return torch.cat([cls.flat(value) for value in state.values()], dim=1)
        return state

    def rollout(self, env: BaseEnv, actions: torch.Tensor) -> torch.Tensor:
        """States and rewards [steps, num_envs, ...] under a sequence of actions."""
        trace = []
        for action in actions:
            _, reward, *_ = env.step(action)
            state = self.flat(env.get_state_dict())
            trace.append(torch.cat([state, reward[:, None]], dim=1))
        return torch.stack(trace)

    @staticmethod
    def grasp_pose(env: BaseEnv) -> None:
        """Bring a PickCube arm (pd_ee_delta_pose) down around the cube, fingers open."""
        position = env.agent.tcp.pose.p.clone()
        position[:, 2] = 0.02
        env.cube.set_pose(Pose.create_from_pq(position))
        env.scene._gpu_apply_all()
        env.scene._gpu_fetch_all()
        for _ in range(14):
            action = torch.zeros(env.num_envs, 7)
            action[:, 6] = 1
            error = env.cube.pose.p - env.agent.tcp.pose.p
            action[:, :3] = (error * 20).clamp(-1, 1)
            env.step(action)
        assert (env.cube.pose.p - env.agent.tcp.pose.p).norm(dim=1).max() < 2e-3


@pytest.fixture(scope="session")
def kit() -> Kit:
    """What the tests share."""
    return Kit()
