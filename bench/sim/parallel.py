"""Parallel environments of a ManiSkill task, in this process or divided among several."""

from __future__ import annotations

from typing import Any, cast

from mani_skill.envs.sapien_env import BaseEnv

from symsteer.bench.sim.environment import Simulator, create_in_process
from symsteer.bench.sim.shards import ShardedEnv
from symsteer.errors import UserError


def create(
    env_cls: type[BaseEnv],
    num_envs: int,
    sim: Simulator = "cpu",
    render: bool = False,
    workers: int = 1,
    **kwargs: Any,
) -> BaseEnv:
    """Make N parallel environments of a ManiSkill task.

    Args:
        env_cls: any `BaseEnv` subclass, ManiSkill's or ours.
        num_envs: N.
        sim: ``"cpu"`` for batched CPU physics, ``"cuda"`` for ManiSkill's GPU simulation.
        render: whether ``env.render()`` must return pictures; needs a Vulkan driver.
        workers: number of processes that share the environments; more than one gives a
            `ShardedEnv`.
        kwargs: passed on to the class.

    Raises:
        UserError: the simulator or the renderer is unknown or not available here, or ManiSkill
            or SAPIEN does not have the version that SymSteer was written for.
    """
    if num_envs < 1:
        raise UserError(f"num_envs is {num_envs}, but at least one environment is needed.")
    if workers == 1:
        return create_in_process(env_cls, num_envs, sim, render, **kwargs)
    if sim != "cpu":
        raise UserError(
            f"workers={workers} divides CPU physics among processes; the GPU simulates all "
            "environments in one: leave workers out, or use sim='cpu'"
        )
    return cast(BaseEnv, ShardedEnv(env_cls, num_envs, workers, render=render, **kwargs))
