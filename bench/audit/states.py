"""States that an expert or a base policy visits, and their turned copies.

States are taken from the unbroken task, one from each episode, so they are independent. Their
copies are turned about a given centre by the elements of a planar group, which act on the whole
simulation state: bodies, robot, controller targets.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from symsteer.bench.audit.arm import ArmTurner
from symsteer.bench.sim.rotations import planar_matrix
from symsteer.bench.sim.trees import join_trees, map_trees, rows_of
from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.tasks.experts import Expert
from symsteer.policies.contract import ChunkPolicy

Element = tuple[float, bool]
"""A planar symmetry: angle in radians, and whether the reflection of y comes first."""

MOVED = 1e-4
"""An object that moves further than this (metres) counts as moving."""


@dataclass(frozen=True)
class Visited:
    """S visited states with the actions that followed; tensors on the CPU.

    Attributes:
        state: simulation states, a tree of ``[S, ...]``.
        actions: the next T actions of the visitor, ``[S, T, 7]``.
        path: the states after each of these actions, a tree of ``[S, T, ...]``.
        moving: whether the manipulated object moves during these T steps of the unbroken task
            (pushed, carried or falling), ``[S]`` bool.
        policy: whether the visitor was the base policy, not the expert, ``[S]`` bool.
    """

    state: dict[str, Any]
    actions: torch.Tensor
    path: dict[str, Any]
    moving: torch.Tensor
    policy: torch.Tensor

    def __len__(self) -> int:
        return len(self.actions)


def visit(
    env: SymmetricTask, count: int, steps: int, seed: int, policy: ChunkPolicy | None = None
) -> Visited:
    """Sample one state from each of ``count`` episodes, uniformly in time before success.

    Args:
        env: the unbroken task; each of its environments plays one episode at a time.
        count: number of states.
        steps: number T of following actions to keep.
        seed: of episodes, noise and sampled times.
        policy: acts in place of the scripted expert: it decodes standard normal noise, its chunks
            are executed, and only states at the start of a chunk are sampled.
    """
    batches = []
    for start in range(0, count, env.num_envs):
        batch = _visit_batch(env, steps, [seed, start], policy)
        batches.append(rows_of(batch, torch.arange(min(env.num_envs, count - start))))
    return join_trees(batches)


def _visit_batch(
    env: SymmetricTask, steps: int, seeds: list[int], policy: ChunkPolicy | None
) -> Visited:
    rng = np.random.default_rng([*seeds, policy is not None])
    episodes = np.asarray(rng.integers(2**31, size=env.num_envs)).tolist()
    generator = torch.Generator().manual_seed(int(rng.integers(2**31)))
    obs, _ = env.reset(seed=episodes, options={"reconfigure": True})
    expert = Expert(env)
    chunk = torch.zeros(0)
    trail, actions = [task_state(env)], []
    length = torch.full((env.num_envs,), env.max_episode_steps - steps + 1)
    for step in range(env.max_episode_steps):
        if policy is None:
            action = expert.act()
        else:
            if step % policy.execute == 0:
                noise = torch.randn(
                    env.num_envs, policy.horizon, policy.act_layout.dim, generator=generator
                )
                device = policy.device
                seen = policy.see(obs.to(device))
                chunk = policy.decode(seen, noise.to(device)).to(env.device)
            action = chunk[:, step % policy.execute]
        obs, _, _, _, info = env.step(action)
        trail.append(task_state(env))
        actions.append(action.cpu().clone())
        won = info["success"].cpu() & (length > step + 1)
        length = torch.where(won, step + 1, length)
        if step + 1 >= int(length.max()) - 1 + steps:
            break
    stride = 1 if policy is None else policy.execute
    choices = (length + stride - 1) // stride
    drawn = torch.as_tensor(rng.uniform(size=env.num_envs)) * choices
    # Steps after that one, and the episodes' numbers: [T + 1, N].
    time = stride * drawn.long() + torch.arange(steps + 1)[:, None]
    every = torch.arange(env.num_envs)
    window = map_trees(lambda *states: torch.stack(states)[time, every], *trail)
    thing = window["actors"][env.manipulated.name][..., :3]
    return Visited(
        state=rows_of(window, 0),
        actions=torch.stack(actions)[time[:-1], every].transpose(0, 1),
        path=map_trees(lambda states: states[1:].transpose(0, 1), window),
        moving=((thing - thing[0]).norm(dim=-1) > MOVED).any(dim=0),
        policy=torch.full((env.num_envs,), policy is not None),
    )


def task_state(env: SymmetricTask) -> dict[str, Any]:
    """The simulation state of all environments on the CPU, without the table."""
    state = env.get_state_dict()
    actors = {k: v for k, v in state["actors"].items() if k != env.table_scene.table.name}
    return map_trees(lambda x: x.detach().cpu().clone(), {**state, "actors": actors})


class Turner:
    """Applies planar symmetries about any centre to simulation states.

    Args:
        env: a task whose ``transform_state`` is used; it is not stepped.
    """

    def __init__(self, env: SymmetricTask) -> None:
        self.env = env
        self.arm = ArmTurner(env) if env.embodiment == "panda" else None

    def turn(
        self, state: dict[str, Any], element: Element, centre: torch.Tensor
    ) -> tuple[dict[str, Any], torch.Tensor]:
        """Transform states.

        Args:
            state: tree of ``[S, ...]``.
            element: the symmetry; the identity does not change a bit of the states.
            centre: fixed point of the symmetry, ``[2]`` metres from the workspace centre.

        Returns:
            The states, and which of them the robot can reach, ``[S]`` bool.
        """
        count = len(next(iter(state["actors"].values())))
        reached = torch.ones(count, dtype=torch.bool)
        if element == (0.0, False):
            return state, reached
        # x -> M x + (1 - M) c: the turn about the workspace centre, then a shift.
        matrix = planar_matrix(*element, centre)[:2, :2]
        offset = (centre - matrix @ centre).expand(count, 2)
        shifted, robot, body = bool(centre.any()), self.env.agent.robot.name, self.env.body
        if self.arm is not None:
            turned = self.env.transform_state({**state, "articulations": {}}, *element)
            joints, reached = self.arm.turn(state["articulations"][robot], *element, offset)
            turned["articulations"] = {**state["articulations"], robot: joints}
        else:
            turned = self.env.transform_state(state, *element)
            if shifted:
                joints = body.shift_robot(turned["articulations"][robot], offset)
                turned["articulations"] = {**turned["articulations"], robot: joints}
            if shifted and "controller" in turned:
                turned["controller"] = body.shift_controller(turned["controller"], offset)
        if shifted:
            turned["actors"] = {k: _shift(v, offset) for k, v in turned["actors"].items()}
        return turned, reached


def seen_from(state: dict[str, Any], centre: torch.Tensor) -> dict[str, Any]:
    """Shift states so that ``centre [2]`` is at the workspace centre, only to observe them.

    The robot's base moves with everything else, so the result is not a state of the task.
    """
    offset = -centre.expand(len(next(iter(state["actors"].values()))), 2)
    moved = {
        kind: {name: _shift(value, offset) for name, value in state[kind].items()}
        for kind in ("actors", "articulations")
    }
    return {**state, **moved}


def _shift(state: torch.Tensor, offset: torch.Tensor) -> torch.Tensor:
    """Move bodies or robot bases by ``offset [S, 2]``; their first two numbers are x and y."""
    moved = state.clone()
    moved[:, :2] += offset
    return moved
