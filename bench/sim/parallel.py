"""Parallel environments of a ManiSkill task, in this process or divided among several."""

from __future__ import annotations

import inspect
import weakref
from collections.abc import Sequence
from functools import partialmethod
from typing import Any, cast

import gymnasium as gym
import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv

from symsteer.bench.sim.environment import Simulator, make_env_class
from symsteer.bench.sim.errors import Unique, WorkerError
from symsteer.bench.sim.seeds import reset_order
from symsteer.bench.sim.shards.workers import WorkerGroup
from symsteer.bench.sim.trees import merge, select
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
    if render:
        kwargs.setdefault("render_mode", "rgb_array")
    if workers == 1:
        return make_env_class(env_cls, sim)(num_envs=num_envs, **kwargs)  # type: ignore[arg-type]
    if sim != "cpu":
        raise UserError(
            f"workers={workers} divides CPU physics among processes; the GPU simulates all "
            "environments in one: leave workers out, or use sim='cpu'"
        )
    return cast(BaseEnv, ShardedEnv(env_cls, num_envs, workers, **kwargs))


def divide(total: int, workers: int) -> list[slice]:
    """Rows of each worker: sizes differ by at most one, larger ones first."""
    shards = np.array_split(np.arange(total), workers)
    return [slice(int(shard[0]), int(shard[-1]) + 1) for shard in shards]


class NotHereError(UserError, AttributeError):
    """The attribute exists in the worker processes only."""


class ShardedEnv(Unique, gym.Env):
    """N environments of a ManiSkill task in W worker processes.

    It behaves as one process with all environments: resets (seeds, partial resets,
    reconfiguration), steps, states, observations, info and spaces are the same. They are equal to
    the bit for tasks that draw only from their environments' own generators, as all of SymSteer's
    do (ManiSkill's stock tasks draw once for the batch). Later calls do not change the tensors
    that it returned.

    The simulation itself (``env.agent``, ``env.scene``, a task's actors) exists in the workers
    only; reading such an attribute raises a `UserError`.

    Args:
        env_cls: task class that can be imported by its name.
        num_envs: N; if W does not divide it, shards differ by one environment.
        workers: W, at most N; more than the cores costs time and memory.
        kwargs: further arguments of the class; tensors with N rows have one for each environment.

    Raises:
        UserError: the number of workers is out of range, an argument cannot be sent to another
            process, or the environments cannot be made.
        WorkerError: a worker failed, or (`WorkerLostError`) its process ended.
    """

    def __init__(self, env_cls: type, num_envs: int, workers: int, **kwargs: Any) -> None:
        if not 1 <= workers <= num_envs:
            raise UserError(
                f"workers is {workers}; it must be at least 1 and at most the number of "
                f"environments, {num_envs}"
            )
        if env_cls.__module__ == "__main__" or "<locals>" in env_cls.__qualname__:
            raise UserError(
                f"workers cannot import the task class {env_cls.__qualname__} by its name: define "
                "it at the top level of a module other than the main program, or use workers=1"
            )
        self.num_envs, self.workers = num_envs, workers
        self.device = torch.device("cpu")
        self._env_cls = env_cls
        self._shards = divide(num_envs, workers)
        self._closed: str | None = None
        names = [
            f"worker {i + 1} of {workers} (environments {rows.start} to {rows.stop - 1})"
            for i, rows in enumerate(self._shards)
        ]
        self._workers = WorkerGroup(names, preload=env_cls.__module__)
        self._end = weakref.finalize(self, self._workers.close)
        recipes: list[tuple | None] = []
        for i, rows in enumerate(self._shards):
            seed = (torch.initial_seed() + i) % 2**63
            shard = select(kwargs, num_envs, rows)
            recipes.append((env_cls, rows.start, rows.stop - rows.start, seed, shard))
        try:
            facts = self._ask("make", recipes)
        except BaseException:
            self._end()
            raise
        for name in ("observation_space", "action_space"):
            single = facts.get(f"single_{name}")
            if single is not None:
                facts[name] = gym.vector.utils.batch_space(single, n=num_envs)
        for name, value in facts.items():
            setattr(self, name, value)

    @property
    def worker_pids(self) -> list[int]:
        """Process ids of the workers."""
        return self._workers.pids

    @property
    def elapsed_steps(self) -> torch.Tensor:
        """Control steps since each environment's last reset, ``[N]``."""
        return self._elapsed

    def step(self, action: Any) -> tuple:
        """One control step of every environment; see ManiSkill's ``BaseEnv.step``."""
        if hasattr(action, "shape") and list(action.shape[:1]) != [self.num_envs]:
            raise UserError(
                f"step takes one row of actions for each of the {self.num_envs} environments; the "
                f"actions' shape is {list(action.shape)}"
            )
        return self._ask("step", [(select(action, self.num_envs, r),) for r in self._shards])

    def step_chunk(self, actions: torch.Tensor, due: torch.Tensor, ends: bool) -> tuple:
        """Execute an action chunk, with one exchange; see ``BatchedCpuMixin.step_chunk``."""
        return self._ask("step_chunk", [(actions[r], due[r], ends) for r in self._shards])

    def reset(self, seed: Any = None, options: dict | None = None) -> tuple:
        """Reset all or some environments; see ``SymmetricTask.reset``.

        Args:
            seed: one integer (expanded as ManiSkill does), one per environment that is reset,
                or None.
            options: ``env_idx`` selects the environments to reset, in any order.

        Raises:
            UserError: the number of seeds does not fit, or only some environments are to be
                reconfigured.
        """
        options = dict(options or {})
        partial = options.pop("env_idx", None)
        if options.get("reconfigure") and partial is not None and len(partial) != self.num_envs:
            raise UserError(
                "some environments cannot be reconfigured without the others: leave out "
                "env_idx or reconfigure"
            )
        index, seeds = reset_order(seed, partial, self.num_envs)
        if seeds is not None:
            super().reset(seed=seeds[0])
        requests: list[tuple | None] = []
        for places, local in self._places(index):
            shard = dict(options)
            if local is not None:
                shard["env_idx"] = local
            requests.append((None if seeds is None else [seeds[i] for i in places], shard))
        obs, info = self._ask("reset", requests)
        return obs, {**info, "reconfigure": bool(options.get("reconfigure", False))}

    def _places(self, env_idx: Any) -> list[tuple[np.ndarray, torch.Tensor | None]]:
        """For each worker: where its environments are in ``env_idx``, and their local numbers."""
        index = np.arange(self.num_envs) if env_idx is None else np.asarray(env_idx)
        shares = [
            (np.flatnonzero((index >= rows.start) & (index < rows.stop)), rows.start)
            for rows in self._shards
        ]
        return [
            (places, None if env_idx is None else torch.as_tensor(index[places] - start))
            for places, start in shares
        ]

    def _call(self, name: str, *args: Any) -> Any:
        """Call a method of the task in all workers."""
        return self._ask(name, [args] * self.workers)

    get_obs = partialmethod(_call, "get_obs")
    get_info = partialmethod(_call, "get_info")
    evaluate = partialmethod(_call, "evaluate")
    get_state_dict = partialmethod(_call, "get_state_dict")
    get_state = partialmethod(_call, "get_state")
    render = partialmethod(_call, "render")

    def _set(self, name: str, state: Any, env_idx: Any = None) -> None:
        """Restore a state in the environments ``env_idx`` (None: all), a row for each."""
        count = self.num_envs if env_idx is None else len(env_idx)
        requests = [
            (select(state, count, places), local) if len(places) else None
            for places, local in self._places(env_idx)
        ]
        self._ask(name, requests)

    set_state_dict = partialmethod(_set, "set_state_dict")
    set_state = partialmethod(_set, "set_state")

    def pause(self, scenes: torch.Tensor) -> None:
        """Save the physics of environments ``[N]`` bool; see ``BatchedCpuMixin.pause``."""
        self._ask("pause", [(scenes[rows],) for rows in self._shards])

    def close(self) -> None:
        """End the workers. Tensors that were returned stay valid."""
        self._closed = self._closed or "because it was closed"
        self._end()

    def __getattr__(self, name: str) -> Any:
        """Look up a constant of the task class."""
        if name.startswith("_"):
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        static = inspect.getattr_static(self._env_cls, name, None)
        if isinstance(static, classmethod | staticmethod):
            return getattr(self._env_cls, name)
        if static is None or callable(static) or hasattr(type(static), "__get__"):
            raise NotHereError(
                f"env.{name} exists in the worker processes only: make the environment with "
                "workers=1 to use it"
            )
        return static

    def _ask(self, name: str, requests: Sequence[tuple | None]) -> Any:
        """Ask the workers and join their answers, a row for each environment.

        After a failure it remembers why no more requests are possible.
        """
        if self._closed:
            raise UserError(f"this environment cannot be used any more, {self._closed}")
        try:
            answers = self._workers.ask(name, requests)
        except (UserError, WorkerError):
            if self._workers.lost:
                self._closed = f"because {self._workers.lost}"
            raise
        except BaseException as error:
            # The answers to this request may still arrive, and would be taken for later ones.
            self._closed = f"because {type(error).__name__} interrupted it"
            self._end()
            raise
        if len(answers) < self.workers:
            return answers[0][0]
        counts = [rows.stop - rows.start for rows in self._shards]
        result, self._elapsed = merge(answers, counts, torch.cat)
        return result
