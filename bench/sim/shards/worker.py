"""The worker process: a batched environment and the loop that answers requests."""

from __future__ import annotations

import copyreg
import io
import multiprocessing
import pickle
import random
import signal
import traceback
from contextlib import suppress
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv

from symsteer.bench.sim.environment import make_env_class
from symsteer.bench.sim.errors import WorkerError
from symsteer.errors import UserError

FACTS = (
    "single_observation_space",
    "single_action_space",
    "metadata",
    "obs_mode",
    "reward_mode",
    "render_mode",
    "control_mode",
    "robot_uids",
    "reconfiguration_freq",
    "sim_freq",
    "control_freq",
    "sim_timestep",
    "control_timestep",
    "task_id",
    "embodiment",
    "body",
)
"""Attributes that are the same in every shard, if the environment has them."""


class _Pickler(pickle.Pickler):
    """Stores tensors as arrays, which is faster than torch's own way."""

    dispatch_table = copyreg.dispatch_table.copy()
    dispatch_table[torch.Tensor] = lambda tensor: (
        torch.from_numpy,
        (tensor.detach().cpu().numpy(),),
    )


def dumps(message: Any) -> bytes:
    """A message as bytes; `pickle.loads` reads them.

    Raises:
        UserError: something in it cannot be sent.
    """
    buffer = io.BytesIO()
    try:
        _Pickler(buffer, pickle.HIGHEST_PROTOCOL).dump(message)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise UserError(
            f"an argument of the environment cannot be sent to a worker process ({error}): "
            "pass plain data, or use workers=1"
        ) from error
    return buffer.getvalue()


def serve(connection: Connection) -> None:
    """Answer requests until the caller closes the connection, or its process has ended.

    A request is the name of a method of `Worker`, or else of the environment, and its arguments.
    The answer is its result with the elapsed steps, or an exception.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    worker = Worker()
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):
        while True:
            request = connection.recv_bytes()
            try:
                name, args = pickle.loads(request)
                method = getattr(worker, name, None) or getattr(worker.env, name)
                answer = dumps((method(*args), worker.env.elapsed_steps))
            except UserError as error:
                answer = dumps(UserError(str(error)))
            except Exception as error:
                who = multiprocessing.current_process().name
                failure = WorkerError(f"{who} failed with {type(error).__name__}: {error}")
                failure.add_note(traceback.format_exc())
                answer = dumps(failure)
            connection.send_bytes(answer)


class Worker:
    """Owns the environments of a shard."""

    env: BaseEnv

    def make(
        self, env_cls: type[BaseEnv], start: int, count: int, seed: int, kwargs: dict[str, Any]
    ) -> dict[str, Any]:
        """Make the environments, in the same state as if one process held those of all shards.

        Args:
            env_cls: the task class, not yet bound to a simulator.
            start: index of the first environment among those of all shards.
            count: how many there are.
            seed: of the process's global random generators.
            kwargs: further arguments of the class.

        Returns:
            The attributes that do not change.
        """
        torch.manual_seed(seed)
        np.random.seed(seed % 2**32)
        random.seed(seed)

        class Shard(env_cls):  # type: ignore[valid-type, misc]
            """Shifts the seeds of the first reset by the number of environments before."""

            _init_raw_obs: Any = None

            def _shifted(self, seed: Any) -> Any:
                making = self._init_raw_obs is None and isinstance(seed, list)
                return [s + start for s in seed] if making else seed

            def _set_main_rng(self, seed: Any) -> None:
                super()._set_main_rng(self._shifted(seed))

            def _set_episode_rng(self, seed: Any, env_idx: Any) -> None:
                super()._set_episode_rng(self._shifted(seed), env_idx)

        self.env = make_env_class(Shard)(num_envs=count, **kwargs)
        return {name: getattr(self.env, name) for name in FACTS if hasattr(self.env, name)}

    def reset(self, seed: list[int] | None, options: dict) -> tuple:
        """Reset the environments in ``options["env_idx"]``: all if it is absent, maybe none."""
        if "env_idx" in options and len(options["env_idx"]) == 0:
            info = self.env.get_info()
            return self.env.get_obs(info), {**info, "reconfigure": False}
        return self.env.reset(seed=seed, options=options)
