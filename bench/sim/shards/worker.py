"""The worker process of a shard: a batched environment and the loop that answers requests."""

from __future__ import annotations

import pickle
import random
import signal
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
import torch
from mani_skill.envs.sapien_env import BaseEnv

from symsteer.bench.sim.environment import create_in_process
from symsteer.bench.sim.shards.block import Field, SharedBlock, put_together, take_apart
from symsteer.bench.sim.shards.messages import FAILURE, MISTAKE, RESULT, SAME, Recipe
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
    "embodiment",
    "body",
)
"""Attributes that are the same in every shard, if the environment has them."""


def make_shard(recipe: Recipe) -> BaseEnv:
    """Make a shard's environments in the same state as if one process held all of them."""
    torch.manual_seed(recipe.seed)
    np.random.seed(recipe.seed % 2**32)
    random.seed(recipe.seed)

    class Shard(recipe.env_cls):  # type: ignore[name-defined, misc]
        """Shifts the seeds of the first reset by the number of environments before the shard."""

        _init_raw_obs: Any = None

        def _own(self, seed: Any) -> Any:
            making = self._init_raw_obs is None and isinstance(seed, list)
            return [s + recipe.start for s in seed] if making else seed

        def _set_main_rng(self, seed: Any) -> None:
            super()._set_main_rng(self._own(seed))

        def _set_episode_rng(self, seed: Any, env_idx: Any) -> None:
            super()._set_episode_rng(self._own(seed), env_idx)

    return create_in_process(Shard, recipe.count, **recipe.kwargs)


def serve(connection: Connection, inbox: SharedBlock, outbox: SharedBlock) -> None:
    """Make a shard and answer requests until the caller closes the connection."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    Worker(connection, inbox, outbox).run()


class Worker:
    """Owns a shard and answers requests until the caller closes the connection.

    Args:
        connection: to the caller's process; the first message is the recipe.
        inbox: shared memory that holds the actions.
        outbox: shared memory that results are written to.
    """

    env: BaseEnv

    def __init__(self, connection: Connection, inbox: SharedBlock, outbox: SharedBlock) -> None:
        self.connection, self.inbox, self.outbox = connection, inbox, outbox
        self.last: dict[str, bytes] = {}

    def run(self) -> None:
        """Answer until the connection ends: the caller closed it, or its process has ended."""
        try:
            recipe = self.connection.recv_bytes()
            while True:
                name, args = pickle.loads(self.connection.recv_bytes())
                try:
                    if recipe:
                        self._make(pickle.loads(recipe))
                        recipe = b""
                    method: Callable = getattr(self, name)
                    self._answer(name, method(*args))
                except Exception as error:
                    self._fail(error)
        except (EOFError, BrokenPipeError, ConnectionResetError):
            return

    def _make(self, recipe: Recipe) -> None:
        self.env = make_shard(recipe)
        self.count = recipe.count
        self.rows = slice(recipe.start, recipe.start + recipe.count)

    # ------------------------------------------------------------------ requests
    def facts(self) -> dict[str, Any]:
        """Attributes of the environment that do not change."""
        found = {name: getattr(self.env, name) for name in FACTS if hasattr(self.env, name)}
        return {**found, "elapsed_steps": self.env.elapsed_steps}

    def _received(self, given: Field) -> torch.Tensor:
        [actions] = self.inbox.fields((given,))
        return actions[self.rows].clone()

    def step(self, given: Field | None, action: Any = None) -> tuple:
        """One step; the action lies in the shared memory, or is ``action`` if it is no tensor."""
        action = action if given is None else self._received(given)
        return (*self.env.step(action), self.env.elapsed_steps)

    def step_chunk(self, given: Field) -> tuple:
        """All steps of a chunk; results are stacked along a second axis."""
        actions = self._received(given)
        parts = []
        for t in range(actions.shape[1]):
            # As in one process (`LatentNoiseEnv`).
            self.env.unwrapped.looks = t == actions.shape[1] - 1
            rows: list[torch.Tensor] = []
            skeleton = take_apart(self.env.step(actions[:, t]), self.count, rows)
            # The simulation may reuse its tensors.
            parts.append([row.clone() for row in rows])
        stacked = [torch.stack(steps, dim=1) for steps in zip(*parts, strict=True)]
        return (*put_together(skeleton, stacked), self.env.elapsed_steps)

    def reset(self, seed: list[int] | None, options: dict) -> tuple:
        """Reset the environments in ``options["env_idx"]``: all if it is absent, maybe none."""
        if "env_idx" in options and len(options["env_idx"]) == 0:
            info = self.env.get_info()
            obs = self.env.get_obs(info)
            info["reconfigure"] = False
        else:
            obs, info = self.env.reset(seed=seed, options=options)
        return obs, info, self.env.elapsed_steps

    def call(self, name: str, *args: Any) -> tuple:
        """Call a method of the environment."""
        return getattr(self.env, name)(*args), self.env.elapsed_steps

    # ------------------------------------------------------------------ answers
    def _answer(self, name: str, tree: Any) -> None:
        """Write the rows of a result to the shared memory and send the skeleton if it changed."""
        rows: list[torch.Tensor] = []
        skeleton = take_apart(tree, self.count, rows)
        fields = tuple(Field.of(row) for row in rows)
        carried = None
        if self.outbox.fits(fields):
            for view, row in zip(self.outbox.fields(fields), rows, strict=True):
                view[self.rows] = row
        else:
            carried = [row.numpy() for row in rows]
        message = pickle.dumps((fields, skeleton, carried))
        if self.last.get(name) == message and carried is None:
            self.connection.send_bytes(SAME)
        else:
            self.last[name] = message
            self.connection.send_bytes(RESULT + message)

    def _fail(self, error: Exception) -> None:
        if isinstance(error, UserError):
            self.connection.send_bytes(MISTAKE + str(error).encode())
        else:
            text = (f"{type(error).__name__}: {error}", traceback.format_exc())
            self.connection.send_bytes(FAILURE + pickle.dumps(text))
