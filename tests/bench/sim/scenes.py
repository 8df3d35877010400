"""Environments for the simulation tests: ours over N scenes, and ManiSkill's own for one."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.utils.registration import REGISTERED_ENVS
from mani_skill.utils.structs.pose import Pose

from symsteer.bench.sim.headless import prepare_headless
from symsteer.bench.sim.parallel import create
from tests.bench.shared import FLAT_TASKS
from tools.speed.simulation import stock_class

TASKS = {
    name.removesuffix("-v1"): stock_class(name) for name in FLAT_TASKS if name in REGISTERED_ENVS
}


def _settings(task: str, settings: dict[str, Any]) -> dict[str, Any]:
    return {
        "robot_uids": "panda_stick" if task == "PushT" else "panda",
        "obs_mode": "state",
        "control_mode": "pd_joint_delta_pos",
        "reward_mode": "dense",
        **settings,
    }


def fresh(task: str, num_envs: int, **settings: Any) -> BaseEnv:
    """A new environment of a task on our batched CPU physics."""
    return create(TASKS[task], num_envs, **_settings(task, settings))


@lru_cache(maxsize=12)
def batched(task: str, num_envs: int, number: int = 0, **settings: Any) -> BaseEnv:
    """As `fresh`, but shared by tests; ``number`` tells several of the same kind apart."""
    return fresh(task, num_envs, **settings)


def stock(task: str, **settings: Any) -> BaseEnv:
    """The same task on ManiSkill's own CPU physics, which allows one environment."""
    prepare_headless()
    kwargs = _settings(task, settings)
    return TASKS[task](sim_backend="physx_cpu", render_backend="none", **kwargs)


def actions(env: BaseEnv, steps: int, seed: int = 0) -> torch.Tensor:
    """Random actions [steps, num_envs, dim], uniform in [-1, 1]."""
    generator = torch.Generator().manual_seed(seed)
    dim = env.single_action_space.shape[0]
    return torch.rand(steps, env.num_envs, dim, generator=generator) * 2 - 1


def rollout(env: BaseEnv, actions: torch.Tensor) -> torch.Tensor:
    """States and rewards [steps, num_envs, ...] under a sequence of actions."""
    trace = []
    for action in actions:
        reward = env.step(action)[1]
        trace.append(torch.cat([env.get_state(), reward[:, None]], dim=1))
    return torch.stack(trace)


def come_down(env: BaseEnv) -> None:
    """Bring a PickCube arm (pd_ee_delta_pose) down around the cube, fingers open."""
    position = env.agent.tcp.pose.p.clone()
    position[:, 2] = 0.02
    env.cube.set_pose(Pose.create_from_pq(position))
    env.scene._gpu_apply_all()
    env.scene._gpu_fetch_all()
    for _ in range(14):
        action = torch.zeros(env.num_envs, 7)
        action[:, 6] = 1
        action[:, :3] = ((env.cube.pose.p - env.agent.tcp.pose.p) * 20).clamp(-1, 1)
        env.step(action)
    assert (env.cube.pose.p - env.agent.tcp.pose.p).norm(dim=1).max() < 2e-3
