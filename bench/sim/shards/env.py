"""N parallel environments in W worker processes, with the interface of one environment."""

from __future__ import annotations

import inspect
import pickle
import signal
import weakref
from collections.abc import Mapping, Sequence
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, NoReturn

import gymnasium as gym
import numpy as np
import torch

from symsteer.bench.sim.errors import Unique, WorkerError, WorkerLostError
from symsteer.bench.sim.shards.block import Field, SharedBlock, put_together, select
from symsteer.bench.sim.shards.messages import FAILURE, MISTAKE, SAME, Recipe, divide
from symsteer.bench.sim.shards.processes import start_process
from symsteer.bench.sim.shards.worker import serve
from symsteer.errors import UserError

_BYTES_PER_ENV = 2**16
"""Shared memory for the actions of one environment, and as much for its results. Larger results
are sent through the pipe."""

_CLOSE_SECONDS = 5.0
"""A worker that has not ended this long after its connection was closed is killed."""


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
        per_env: arguments of the class with one entry per environment.
        attributes: further attributes of this object.
        kwargs: further arguments of `environment.create_in_process`.

    Raises:
        UserError: the number of workers is out of range, an argument cannot be sent to another
            process, or the environments cannot be made.
        WorkerError: a worker failed, or (`WorkerLostError`) its process ended.
    """

    def __init__(
        self,
        env_cls: type,
        num_envs: int,
        workers: int,
        per_env: Mapping[str, Any] | None = None,
        attributes: Mapping[str, Any] | None = None,
        **kwargs: Any,
    ) -> None:
        if not 1 <= workers <= num_envs:
            raise UserError(
                f"workers is {workers}; it must be at least 1 and at most the number of "
                f"environments, {num_envs}"
            )
        for name, values in (per_env or {}).items():
            if len(values) != num_envs:
                raise UserError(
                    f"{name} has {len(values)} entries for {num_envs} environments; give one "
                    "number, or one for each environment"
                )
        self.num_envs, self.workers = num_envs, workers
        self.device = torch.device("cpu")
        self._env_cls = env_cls
        self._rows = divide(num_envs, workers)
        self._closed: str | None = None
        self._pool = _Pool(
            [
                _recipe(env_cls, rows, i, {k: v[rows] for k, v in (per_env or {}).items()}, kwargs)
                for i, rows in enumerate(self._rows)
            ],
            num_envs,
            preload=env_cls.__module__,
        )
        self._end = weakref.finalize(self, self._pool.close)
        try:
            facts = self._ask("facts", [()] * workers)
        except BaseException:
            self._end()
            raise
        self._elapsed: torch.Tensor = facts.pop("elapsed_steps")
        for name in ("observation_space", "action_space"):
            single = facts.get(f"single_{name}")
            if single is not None:
                facts[name] = gym.vector.utils.batch_space(single, n=num_envs)
        for name, value in {**facts, **(attributes or {})}.items():
            setattr(self, name, value)

    @property
    def worker_pids(self) -> list[int]:
        """Process ids of the workers."""
        return self._pool.pids

    # ------------------------------------------------------------------ stepping
    @property
    def elapsed_steps(self) -> torch.Tensor:
        """Control steps since each environment's last reset, ``[N]``."""
        return self._elapsed

    def step(self, action: Any) -> tuple:
        """One control step of every environment; see ManiSkill's ``BaseEnv.step``."""
        if action is None or isinstance(action, dict | list | tuple):
            parts = [select(_tensors(action), self.num_envs, rows) for rows in self._rows]
            *result, elapsed = self._ask("step", [(None, part) for part in parts])
        else:
            given = self._give(action, "step")
            *result, elapsed = self._ask("step", [(given,)] * self.workers)
        self._elapsed = elapsed
        return tuple(result)

    def step_chunk(self, actions: Any) -> tuple:
        """Execute an action chunk, with one exchange between processes.

        Args:
            actions: ``[N, T, action_dim]``.

        Returns:
            The results of T calls of :meth:`step`, stacked along a second axis: observations
            ``[N, T, ...]``, rewards, terminated and truncated ``[N, T]``, info. No environment is
            reset in between.
        """
        given = self._give(actions, "step_chunk")
        if len(given.shape) != 2 or given.shape[0] == 0:
            raise UserError(
                "step_chunk takes actions of shape [environments, steps, action]; their shape is "
                f"{[self.num_envs, *given.shape]}"
            )
        *result, self._elapsed = self._ask("step_chunk", [(given,)] * self.workers)
        return tuple(result)

    def _give(self, actions: Any, method: str) -> Field:
        """Write actions to the shared memory; returns their field."""
        self._check_open()
        actions = _tensors(actions if hasattr(actions, "dtype") else np.asarray(actions))
        if not actions.ndim or len(actions) != self.num_envs:
            raise UserError(
                f"{method} takes one row of actions for each of the {self.num_envs} environments; "
                f"the actions' shape is {list(actions.shape)}"
            )
        given = Field.of(actions)
        inbox = self._pool.inbox
        if not inbox.fits((given,)):
            raise UserError(
                f"{method} takes at most {_BYTES_PER_ENV} bytes of actions per environment; these "
                f"are {given.bytes(1)}"
            )
        inbox.fields((given,))[0][:] = actions
        return given

    # ------------------------------------------------------------------ resets
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
        if partial is None:
            index, order = torch.arange(self.num_envs), torch.arange(self.num_envs)
        else:
            index, order = _index(partial).sort()
            if options.get("reconfigure") and len(index) != self.num_envs:
                raise UserError(
                    "some environments cannot be reconfigured without the others: leave out "
                    "env_idx or reconfigure"
                )
        seeds = None
        if seed is not None:
            seeds = [int(s) for s in np.atleast_1d(np.asarray(seed))]
            super().reset(seed=seeds[0])
            if len(seeds) not in (1, len(index)):
                raise UserError(
                    f"{len(seeds)} seeds were given for {len(index)} environments; give one each"
                )
            if len(seeds) == len(index):
                seeds = [seeds[i] for i in order.tolist()]
            else:
                more = np.random.RandomState(seeds[0]).randint(2**31, size=len(index) - 1)
                seeds += more.tolist()
        states = options.pop("reset_to_env_states", None)
        requests = []
        for rows in self._rows:
            mine = ((index >= rows.start) & (index < rows.stop)).nonzero().flatten()
            part = dict(options)
            if partial is not None:
                part["env_idx"] = index[mine] - rows.start
            if states is not None:
                part["reset_to_env_states"] = select(_tensors(states), len(index), mine)
            requests.append((None if seeds is None else [seeds[i] for i in mine.tolist()], part))
        obs, info, self._elapsed = self._ask("reset", requests)
        info["reconfigure"] = bool(options.get("reconfigure", False))
        return obs, info

    # ------------------------------------------------------------------ reading and writing
    def _call(self, name: str, *args: Any) -> Any:
        result, self._elapsed = self._ask("call", [(name, *args)] * self.workers)
        return result

    def get_obs(self, info: dict | None = None) -> Any:
        """The current observation."""
        return self._call("get_obs")

    def get_info(self) -> dict:
        """The current info."""
        return self._call("get_info")

    def evaluate(self) -> dict:
        """Success and other facts about the current state."""
        return self._call("evaluate")

    def get_state_dict(self) -> dict:
        """State of simulation and controllers, tensors ``[N, ...]``."""
        return self._call("get_state_dict")

    def get_state(self) -> torch.Tensor:
        """The state dictionary as one tensor ``[N, ...]``."""
        return self._call("get_state")

    def set_state_dict(self, state: dict, env_idx: Any = None) -> None:
        """Restore a state; see ``SymmetricTask.set_state_dict``.

        Args:
            state: tensors or arrays with a row per environment that is set.
            env_idx: which environments, in the order of the rows; None for all.
        """
        self._set("set_state_dict", state, env_idx)

    def set_state(self, state: Any, env_idx: Any = None) -> None:
        """Restore a state that is one tensor; see `set_state_dict`."""
        self._set("set_state", state, env_idx)

    def _set(self, name: str, state: Any, env_idx: Any) -> None:
        index = torch.arange(self.num_envs) if env_idx is None else _index(env_idx)
        state = _batched(_tensors(state))
        requests: list[tuple | None] = []
        for rows in self._rows:
            mine = ((index >= rows.start) & (index < rows.stop)).nonzero().flatten()
            part = select(state, len(index), mine)
            local = None if env_idx is None else index[mine] - rows.start
            requests.append((name, part, local) if len(mine) else None)
        self._ask("call", requests)

    def pause(self, scenes: torch.Tensor) -> None:
        """Save the physics of environments ``[N]`` bool; see ``BatchedCpuMixin.pause``."""
        self._ask("call", [("pause", scenes[rows]) for rows in self._rows])

    def transform_state(self, state: dict, angle: float, reflect: bool = False) -> dict:
        """Turn a state about the workspace centre; see ``SymmetricTask.transform_state``."""
        request = ("transform_state", _tensors(state), angle, reflect)
        requests: list[tuple | None] = [request, *[None] * (self.workers - 1)]
        turned, _ = self._ask("call", requests)
        return turned

    def render(self) -> Any:
        """Pictures of all environments, if ``render_mode`` was given."""
        return self._call("render")

    # ------------------------------------------------------------------ the rest
    def close(self) -> None:
        """End the workers. Tensors that were returned stay valid."""
        self._closed = self._closed or "because it was closed"
        self._end()

    def __getattr__(self, name: str) -> Any:
        """Look up a constant of the task class."""
        if name.startswith("_"):
            raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}")
        missing = object()
        found = inspect.getattr_static(self._env_cls, name, missing)
        if found is not missing:
            if isinstance(found, classmethod | staticmethod):
                return getattr(self._env_cls, name)
            if not (callable(found) or hasattr(type(found), "__get__")) and found is not None:
                return found
        raise NotHereError(
            f"env.{name} exists in the worker processes only: make the environment with workers=1 "
            "to use it"
        )

    def __str__(self) -> str:
        return f"<{self.workers} workers with {self.num_envs} environments of {self._env_cls}>"

    def _check_open(self) -> None:
        if self._closed:
            raise UserError(f"this environment cannot be used any more, {self._closed}")

    def _ask(self, name: str, requests: Sequence[tuple | None]) -> Any:
        """Ask the workers, and remember why no more requests are possible after a failure."""
        self._check_open()
        try:
            return self._pool.ask(name, requests)
        except (UserError, WorkerError):
            if self._pool.lost:
                self._closed = f"because {self._pool.lost}"
            raise
        except BaseException as error:
            # The answers to this request may still arrive, and would be taken for later ones.
            self._closed = f"because {type(error).__name__} interrupted it"
            self._end()
            raise


class _Pool:
    """The worker processes and the memory shared with them."""

    def __init__(self, recipes: list[bytes], num_envs: int, preload: str) -> None:
        self.rows = divide(num_envs, len(recipes))
        self.inbox = SharedBlock(_BYTES_PER_ENV * num_envs, num_envs)
        self.outbox = SharedBlock(_BYTES_PER_ENV * num_envs, num_envs)
        self.lost = ""
        self.processes: list[BaseProcess] = []
        self.connections: list[Connection] = []
        self.answers: list[dict[str, tuple]] = [{} for _ in recipes]
        try:
            for i, recipe in enumerate(recipes):
                ours, theirs = Pipe()
                self.connections.append(ours)
                with theirs:
                    process = start_process(
                        serve,
                        theirs,
                        self.inbox,
                        self.outbox,
                        preload=preload,
                        name=f"symsteer-shard-{i + 1}-of-{len(recipes)}",
                    )
                self.processes.append(process)
                ours.send_bytes(recipe)
        except BaseException:
            self.close()
            raise
        finally:
            self.inbox.close_descriptor()
            self.outbox.close_descriptor()

    @property
    def pids(self) -> list[int]:
        """Process ids of the workers."""
        return [process.pid for process in self.processes if process.pid is not None]

    def ask(self, name: str, requests: Sequence[tuple | None]) -> Any:
        """Send every worker its request (None: none) and join the answers."""
        asked = [i for i, request in enumerate(requests) if request is not None]
        for i in asked:
            try:
                self.connections[i].send_bytes(pickle.dumps((name, requests[i])))
            except (BrokenPipeError, ConnectionResetError):
                self._lose(i)
        # Receive all answers before raising: none may be left in a pipe for the next request.
        errors: list[Exception] = []
        for i in asked:
            try:
                answer = self.connections[i].recv_bytes()
            except (EOFError, ConnectionResetError):
                self._lose(i)
            kind, content = answer[:1], answer[1:]
            if kind == MISTAKE:
                errors.append(UserError(content.decode()))
            elif kind == FAILURE:
                errors.append(self._failure(i, *pickle.loads(content)))
            elif kind != SAME:
                self.answers[i][name] = pickle.loads(content)
        if errors:
            # A bug explains more than a user's mistake, so it goes first.
            raise next((e for e in errors if isinstance(e, WorkerError)), errors[0])
        return self._join(name, asked)

    def _join(self, name: str, asked: list[int]) -> Any:
        answers = [self.answers[i][name] for i in asked]
        fields, skeleton, carried = answers[0]
        if any(answer[0] != fields for answer in answers):
            raise RuntimeError(f"the workers' answers to {name!r} do not fit together")
        if carried is not None:
            rows = [
                torch.cat([torch.from_numpy(answer[2][k]) for answer in answers])
                for k in range(len(fields))
            ]
        elif len(asked) == len(self.rows):
            rows = [view.clone() for view in self.outbox.fields(fields)]
        else:
            rows = [
                torch.cat([view[self.rows[i]] for i in asked])
                for view in self.outbox.fields(fields)
            ]
        return put_together(skeleton, rows)

    def _failure(self, i: int, summary: str, trace: str) -> WorkerError:
        error = WorkerError(f"{self._name(i)} failed with {summary}")
        error.__cause__ = WorkerError(f"\n{trace}")
        return error

    def _lose(self, i: int) -> NoReturn:
        """Close all workers because worker ``i`` has ended, and say how it ended."""
        process = self.processes[i]
        process.join(_CLOSE_SECONDS)
        code = process.exitcode
        if code is None:
            how = "closed its connection"
        elif code < 0:
            try:
                how = f"was killed by {signal.Signals(-code).name}"
            except ValueError:
                how = f"was killed by signal {-code}"
            if -code == signal.SIGKILL:
                how += " (as the system does when memory runs out)"
        else:
            how = f"ended with exit code {code}"
        self.lost = f"{self._name(i)} {how}"
        self.close()
        raise WorkerLostError(
            f"{self.lost}, and the environments with it: make the environment again"
        ) from None

    def _name(self, i: int) -> str:
        rows = self.rows[i]
        return f"worker {i + 1} of {len(self.rows)} (environments {rows.start} to {rows.stop - 1})"

    def close(self) -> None:
        """Close the connections, which ends the workers; kill those that take too long."""
        for connection in self.connections:
            connection.close()
        for process in self.processes:
            process.join(_CLOSE_SECONDS)
            if process.is_alive():
                process.kill()
                process.join()
            process.close()
        self.processes.clear()
        # The memory is unmapped with the last tensor that uses it.
        self.__dict__.pop("inbox", None)
        self.__dict__.pop("outbox", None)


def _recipe(
    env_cls: type, rows: slice, number: int, per_env: dict[str, Any], kwargs: dict[str, Any]
) -> bytes:
    if env_cls.__module__ == "__main__" or "<locals>" in env_cls.__qualname__:
        raise UserError(
            f"workers cannot import the task class {env_cls.__qualname__} by its name: define it "
            "at the top level of a module other than the main program, or use workers=1"
        )
    seed = (torch.initial_seed() + number) % 2**63
    recipe = Recipe(env_cls, rows.start, rows.stop - rows.start, seed, {**kwargs, **per_env})
    try:
        return pickle.dumps(recipe)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise UserError(
            f"an argument of the environment cannot be sent to a worker process ({error}): "
            "pass plain data, or use workers=1"
        ) from error


def _index(env_idx: Any) -> torch.Tensor:
    return torch.as_tensor(env_idx, dtype=torch.long).cpu().flatten()


def _tensors(tree: Any) -> Any:
    """The tree with arrays as tensors; float64 arrays become float32, as in ManiSkill."""
    if isinstance(tree, dict):
        return {key: _tensors(value) for key, value in tree.items()}
    if isinstance(tree, np.ndarray):
        tensor = torch.from_numpy(tree)
        return tensor.float() if tensor.dtype == torch.float64 else tensor
    return tree.detach().cpu() if isinstance(tree, torch.Tensor) else tree


def _batched(tree: Any) -> Any:
    """Add the axis of environments to a state that has none."""
    if isinstance(tree, dict):
        return {key: _batched(value) for key, value in tree.items()}
    return tree[None] if isinstance(tree, torch.Tensor) and tree.ndim == 1 else tree
