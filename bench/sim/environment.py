"""ManiSkill environments on batched CPU physics, or on ManiSkill's own GPU simulation."""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from typing import Any, Literal

import sapien
import sapien.physx as physx
from mani_skill.agents.base_agent import BaseAgent
from mani_skill.agents.multi_agent import MultiAgent
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.envs.utils.system.backend import BackendInfo

from bench.sim import patches
from bench.sim.headless import prepare_headless
from bench.sim.scene import BatchedScene
from policies.errors import UserError

Simulator = Literal["cpu", "cuda"]


class _BatchedDevice:
    """The simulation device as ManiSkill asks for it: "cuda" means that buffers are applied."""

    def is_cuda(self) -> bool:
        return True

    def is_cpu(self) -> bool:
        return False


class BatchedCpuMixin:
    """Runs a ManiSkill task for N environments in one process on CPU physics.

    Mix in before a `BaseEnv` subclass: ``class MyEnv(BatchedCpuMixin, PickCubeEnv)``. Takes the
    arguments of that class; ``sim_backend`` and ``render_backend`` are set here.
    """

    def __init__(self, *args: Any, num_envs: int = 1, **kwargs: Any) -> None:
        kwargs["sim_backend"] = "physx_cpu"
        kwargs["render_backend"] = "none"
        if kwargs.get("parallel_in_single_scene"):
            raise UserError("parallel_in_single_scene needs the GPU simulation: use sim='cuda'.")
        patches.install()
        prepare_headless()
        super().__init__(*args, num_envs=num_envs, **kwargs)

    @property
    def backend(self) -> BackendInfo:
        return self._backend

    @backend.setter
    def backend(self, info: BackendInfo) -> None:
        # Another name than ManiSkill's CPU backends, which refuse several environments.
        self._backend = dataclasses.replace(info, sim_backend="physx_cpu_batched")

    @property
    def _sim_device(self) -> _BatchedDevice:
        return _BatchedDevice()

    @_sim_device.setter
    def _sim_device(self, device: sapien.Device) -> None:
        """Ignored: BaseEnv assigns the plain CPU device."""

    def _setup_scene(self) -> None:
        self._set_scene_config()
        self.scene = BatchedScene(
            [sapien.Scene([physx.PhysxCpuSystem()]) for _ in range(self.num_envs)],
            sim_config=self.sim_config,
            device=self.device,
            backend=self.backend,
        )
        self.scene.timestep = 1.0 / self._sim_freq

    def _step_action(self, action: Any) -> Any:
        if self._code_runs_between_substeps():
            return super()._step_action(action)
        with self.scene.px.deferred_substeps():
            return super()._step_action(action)

    def _after_control_step(self) -> None:
        self.scene.px.finish_substeps()
        super()._after_control_step()

    def _code_runs_between_substeps(self) -> bool:
        """Whether the task or the robot overrides a hook that may touch SAPIEN's objects."""
        agent = type(self.agent)
        return not (
            type(self)._before_simulation_step is BaseEnv._before_simulation_step
            and type(self)._after_simulation_step is BaseEnv._after_simulation_step
            and agent.before_simulation_step
            in (BaseAgent.before_simulation_step, MultiAgent.before_simulation_step)
        )


class CudaMixin:
    """Runs a ManiSkill task on ManiSkill's own GPU simulation, also for one environment."""

    def __init__(self, *args: Any, num_envs: int = 1, **kwargs: Any) -> None:
        kwargs["sim_backend"] = "physx_cuda"
        kwargs.setdefault("render_backend", "none")
        prepare_headless()
        super().__init__(*args, num_envs=num_envs, **kwargs)


@lru_cache(maxsize=None)
def make_env_class(env_cls: type[BaseEnv], sim: Simulator = "cpu") -> type[BaseEnv]:
    """A subclass of a ManiSkill task class that runs on the given simulator.

    Args:
        env_cls: any `BaseEnv` subclass, ManiSkill's or ours.
        sim: ``"cpu"`` for batched CPU physics, ``"cuda"`` for ManiSkill's GPU simulation.
    """
    if sim not in ("cpu", "cuda"):
        raise UserError(f'Unknown simulator "{sim}": choose "cpu" or "cuda".')
    mixin = BatchedCpuMixin if sim == "cpu" else CudaMixin
    return type(
        f"{env_cls.__name__}_{sim}",
        (mixin, env_cls),
        {"__module__": env_cls.__module__, "__doc__": env_cls.__doc__},
    )


def create(
    env_cls: type[BaseEnv],
    num_envs: int,
    sim: Simulator = "cpu",
    render: bool = False,
    **kwargs: Any,
) -> BaseEnv:
    """Make N parallel environments of a ManiSkill task.

    Args:
        env_cls: any `BaseEnv` subclass, ManiSkill's or ours.
        num_envs: how many environments.
        sim: ``"cpu"`` or ``"cuda"``.
        render: whether ``env.render()`` must work; needs a Vulkan driver.
        kwargs: passed on to the class.

    Raises:
        UserError: the simulator is unknown or not available here, or the wrong release.
    """
    if num_envs < 1:
        raise UserError(f"num_envs is {num_envs}, but at least one environment is needed.")
    return make_env_class(env_cls, sim)(num_envs=num_envs, **kwargs)
