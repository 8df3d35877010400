"""ManiSkill environments on batched CPU physics, or on ManiSkill's own GPU simulation."""

from __future__ import annotations

import dataclasses
import gc
import warnings
import weakref
from collections.abc import Iterable
from functools import cache
from types import SimpleNamespace
from typing import Any, Literal

import sapien
import sapien.physx as physx
import sapien.render
import torch
from mani_skill.agents.base_agent import BaseAgent
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.envs.utils.system.backend import BackendInfo
from mani_skill.utils.structs import Actor

from symsteer.bench.sim import patches, rendering
from symsteer.bench.sim.errors import Unique
from symsteer.bench.sim.headless import prepare_headless
from symsteer.bench.sim.scene import BatchedScene
from symsteer.bench.sim.trees import merge
from symsteer.bench.sim.versions import first_warning
from symsteer.errors import UserError

Simulator = Literal["cpu", "cuda"]

# Collecting garbage takes 0.27 s, most of it in the modules and classes of torch and ManiSkill,
# which live as long as the process. They are taken out here, before there is an environment: what
# is taken out is never collected.
gc.collect()
gc.freeze()

MAX_SCENES = 900
"""PhysX scenes that one process may hold. With about 1,000 of them the interpreter ends with a
fatal error (``_PyGILState_NoteThreadState``)."""

MAX_DROPPED = 256
"""PhysX scenes without an environment that may wait until garbage is collected."""

_LIVE_SCENES: weakref.WeakSet[BatchedScene] = weakref.WeakSet()
_DROPPED_SCENES: weakref.WeakSet[BatchedScene] = weakref.WeakSet()


def _make_room(count: int) -> None:
    """Raise `UserError` unless this process can hold ``count`` more scenes."""
    if _count(_LIVE_SCENES) + count > MAX_SCENES:
        # Closed environments hold their scenes until they are collected.
        gc.collect()
    if (there := _count(_LIVE_SCENES)) + count > MAX_SCENES:
        raise UserError(
            f"one process holds at most {MAX_SCENES} PhysX scenes: {count} were asked for and "
            f"{there} exist already (a reset that reconfigures needs twice as many); make fewer "
            "environments, or divide them among processes with workers"
        )


def _count(scenes: Iterable[BatchedScene]) -> int:
    """The number of PhysX scenes."""
    return sum(len(scene.sub_scenes) for scene in scenes)


# Makes ManiSkill take its GPU branch, which applies buffers.
_BATCHED_DEVICE = SimpleNamespace(is_cuda=lambda: True, is_cpu=lambda: False)


class _OnSimulator(Unique, BaseEnv):
    """What both kinds of environments do before ManiSkill makes them.

    Cameras exist only if ``render_mode``, a visual ``obs_mode`` or the task asks for them; they
    need a Vulkan driver.
    """

    def __init__(
        self,
        *args: Any,
        obs_mode: str | None = None,
        render_mode: str | None = None,
        render_backend: str | None = None,
        **kwargs: Any,
    ) -> None:
        visual = obs_mode not in (None, "state", "state_dict", "none")
        cameras = visual or render_mode is not None or getattr(self, "needs_cameras", False)
        if warning := first_warning():
            warnings.warn(warning, stacklevel=2)
        can_render = prepare_headless()
        backends = self._prepare(cameras, render_backend)
        # SAPIEN's renderer ends with the last object that needs it, and starts anew for the next
        # material. On a GPU this is slow, and fails after some hundred times.
        self._renderer = sapien.render.RenderMaterial() if can_render and not cameras else None
        super().__init__(*args, obs_mode=obs_mode, render_mode=render_mode, **backends, **kwargs)

    looks = True
    brief = False
    _last_obs: Any

    def step_chunk(self, actions: torch.Tensor, due: torch.Tensor, ends: bool) -> tuple:
        """Execute an action chunk, also the steps after an episode's end.

        No environment is reset in between. So scenes have the same history in one process and in
        several, and results are equal bit for bit.

        Args:
            actions: ``[N, T, action_dim]``.
            due: steps that end an episode by time, ``[N, T]`` bool.
            ends: whether success ends an episode.

        Returns:
            Observations ``[N, T, ...]``, new where some episode ends and in the last step, else the
            last ones; info of all steps, stacked alike.
        """
        n, steps = actions.shape[:2]
        obs, results = self._last_obs, []
        for t in range(steps):
            self.looks, self.brief = t == steps - 1, True
            try:
                *_, info = self.step(actions[:, t])
            finally:
                self.brief = False
            if self.looks or due[:, t].any() or (ends and info["success"].any()):
                obs = self._last_obs = self.get_obs(info)
            # The simulation may reuse its tensors.
            results.append(merge([(obs, info)], [n], lambda tensors: tensors[0].clone()))
        return merge(results, [n] * steps, lambda tensors: torch.stack(tensors, dim=1))

    def get_obs(self, info: dict | None = None, unflattened: bool = False) -> Any:
        return self._last_obs if self.brief else super().get_obs(info, unflattened)

    def _flatten_raw_obs(self, obs: Any) -> Any:
        return obs if self.brief else super()._flatten_raw_obs(obs)

    def get_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """As ManiSkill's; zero where nobody asks for it."""
        if self.brief:
            return torch.zeros(self.num_envs, device=self.device)
        return super().get_reward(obs, action, info)

    def _prepare(self, cameras: bool, render_backend: str | None) -> dict[str, str]:
        """Check that the simulator works here; returns ManiSkill's names of the backends."""
        raise NotImplementedError


class BatchedCpuMixin(_OnSimulator):
    """Runs a ManiSkill task for N environments in one process on CPU physics.

    Mix in before a `BaseEnv` subclass: ``class MyEnv(BatchedCpuMixin, PickCubeEnv)``. Takes the
    arguments of that class.

    Raises:
        UserError: cameras are asked for without a Vulkan driver.
    """

    def _prepare(self, cameras: bool, render_backend: str | None) -> dict[str, str]:
        patches.install()
        self._camera_device = rendering.find_device(render_backend) if cameras else None
        return {"sim_backend": "physx_cpu", "render_backend": "none"}

    @property
    def backend(self) -> BackendInfo:
        """Devices and names of simulation and rendering."""
        return self._backend

    @backend.setter
    def backend(self, info: BackendInfo) -> None:
        # ManiSkill refuses several environments on its own CPU backends, so the name differs.
        # Its parser may not know the render device either.
        self._backend = dataclasses.replace(
            info,
            sim_backend="physx_cpu_batched",
            render_device=self._camera_device,
            render_backend="none" if self._camera_device is None else self._camera_device.name,
        )

    # `BaseEnv` assigns a plain CPU device.
    _sim_device = property(lambda self: _BATCHED_DEVICE, lambda self, device: None)

    def _clear(self) -> None:
        """Drop the scenes. ManiSkill collects garbage each time, this only if many wait for it."""
        if self.scene is not None:
            _DROPPED_SCENES.add(self.scene)
        self._close_viewer()
        self.__dict__.update(agent=None, scene=None)
        self.__dict__.update(_sensors={}, _human_render_cameras={}, _hidden_objects=[])
        if self._camera_device is not None or _count(_DROPPED_SCENES) > MAX_DROPPED:
            gc.collect()

    def _reconfigure(self, options: dict | None = None) -> None:
        # Before the scenes are dropped: after a refusal they can still be used.
        _make_room(self.num_envs)
        super()._reconfigure(options or {})

    def _setup_scene(self) -> None:
        self._set_scene_config()
        sub_scenes = []
        for _ in range(self.num_envs):
            systems: list[sapien.System] = [physx.PhysxCpuSystem()]
            if self._camera_device is not None:
                systems.append(sapien.render.RenderSystem(self._camera_device))
            sub_scenes.append(sapien.Scene(systems))
        self.scene = BatchedScene(
            sub_scenes, sim_config=self.sim_config, device=self.device, backend=self.backend
        )
        self.scene.timestep = 1.0 / self._sim_freq
        _LIVE_SCENES.add(self.scene)

    def hold_force(self, body: Actor, force: torch.Tensor) -> None:
        """Apply a force to a dynamic body in every substep until the next call for that body.

        No code runs between substeps for this, so it costs little.

        Args:
            body: an actor of all environments.
            force: ``[N, 3]`` newtons in the world frame, at the centre of mass.
        """
        self.scene.px.hold_forces(body._body_data_index.numpy(), force.numpy())

    def pause(self, scenes: torch.Tensor) -> None:
        """Save the physics of environments whose further steps do not matter.

        Args:
            scenes: ``[N]`` bool, those that stand still until the next call or reconfiguration.
                The others do not notice.
        """
        self.scene.px.pause(scenes.numpy())

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
        task, agent = type(self), BaseAgent if self.agent is None else type(self.agent)
        return not (
            task._before_simulation_step is BaseEnv._before_simulation_step
            and task._after_simulation_step is BaseEnv._after_simulation_step
            and agent.before_simulation_step is BaseAgent.before_simulation_step
        )


class CudaMixin(_OnSimulator):
    """Runs a ManiSkill task on ManiSkill's own GPU simulation, also for one environment.

    Raises:
        UserError: CUDA or PhysX's GPU library is missing.
    """

    def _prepare(self, cameras: bool, render_backend: str | None) -> dict[str, str]:
        check_cuda()
        self._held: dict[str, tuple[Actor, torch.Tensor]] = {}
        default = "gpu" if cameras else "none"
        return {"sim_backend": "physx_cuda", "render_backend": render_backend or default}

    def hold_force(self, body: Actor, force: torch.Tensor) -> None:
        """Apply a force in every substep; see `BatchedCpuMixin.hold_force`."""
        self._held[body.name] = (body, force)

    def pause(self, scenes: torch.Tensor) -> None:
        """Do nothing: the GPU simulates all scenes at once; see `BatchedCpuMixin.pause`."""

    def _setup_scene(self) -> None:
        self._held.clear()
        super()._setup_scene()

    def _before_simulation_step(self) -> None:
        for body, force in self._held.values():
            body.apply_force(force)
        super()._before_simulation_step()


def check_cuda() -> None:
    """Raise `UserError` unless ManiSkill's GPU simulation can run here."""
    if not torch.cuda.is_available():
        raise UserError(
            "sim='cuda' needs an NVIDIA GPU and the CUDA build of torch: use sim='cpu' here."
        )
    try:
        physx.enable_gpu()
    except Exception as error:  # a network or a loader error if the library is missing
        raise UserError(
            "sim='cuda' needs PhysX's GPU library, which SAPIEN could not download or load "
            f"({type(error).__name__}): use sim='cpu', which also works with the learner on the "
            "GPU."
        ) from error


@cache
def make_env_class(env_cls: type[BaseEnv], sim: Simulator = "cpu") -> type[BaseEnv]:
    """A subclass of a ManiSkill task class that runs on the given simulator.

    Args:
        env_cls: any `BaseEnv` subclass, ManiSkill's or ours.
        sim: ``"cpu"`` for batched CPU physics, ``"cuda"`` for ManiSkill's GPU simulation.

    Raises:
        UserError: there is no such simulator.
    """
    if sim not in ("cpu", "cuda"):
        raise UserError(f'Unknown simulator "{sim}": choose "cpu" or "cuda".')
    mixin = BatchedCpuMixin if sim == "cpu" else CudaMixin
    members = {"__module__": env_cls.__module__, "__doc__": env_cls.__doc__}
    return type(f"{env_cls.__name__}_{sim}", (mixin, env_cls), members)
