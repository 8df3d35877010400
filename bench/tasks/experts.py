"""Scripted experts for all environments at once.

Each expert is a function of the present state: where to move the tool centre point, how to turn
it, and whether to close the fingers. It uses relative vectors, heights and yaw differences only,
so rotating a state rotates its action. Phases follow from geometry rather than from a counter
(an observer of the state can infer them), and pass into one another through funnels: the further
from the axis of a grasp, the higher the gripper stays.

An offset [N, 3] moves the point that is grasped or pushed; diverse demonstrations use it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

from bench.tasks.base import SymmetricTask, fourfold_yaw
from bench.tasks.rotations import quaternion_to_matrix, wrap
from policies.errors import UserError

OPEN, CLOSED = 1.0, -1.0
HOVER = 0.07
"""Height of the gripper above a grasp while it is far from its axis, metres."""


@dataclass(frozen=True)
class Intent:
    """What an expert wants in this step; all ``[N, ...]``, in the world's frame."""

    move: torch.Tensor
    """Displacement of the tool centre point, ``[N, 3]`` metres."""
    yaw: torch.Tensor
    """Turn about the vertical, ``[N]`` radians."""
    gripper: torch.Tensor
    """+1 open, -1 closed, ``[N]``."""


class Expert:
    """Solves a task from its privileged state.

    Args:
        env: a task made by :func:`bench.tasks.make`, any embodiment.

    Raises:
        UserError: if the task has no expert.
    """

    def __init__(self, env: SymmetricTask):
        if env.task_id not in _INTENTS:
            raise UserError(
                f"{env.task_id!r} has no expert; there is one for {', '.join(_INTENTS)}"
            )
        self.env = env
        self.offset = torch.zeros(env.num_envs, 3, device=env.device)
        self._intent = _INTENTS[env.task_id]

    def act(self) -> torch.Tensor:
        """The action for the present state, ``[N, 7]``, bounded."""
        env = self.env
        intent = self._intent(env, self.offset)
        tool = quaternion_to_matrix(env.agent.tcp_pose.q)[:, :, 2]
        # Turning by tool x down brings the tool axis back to straight down.
        level = torch.stack([-tool[:, 1], tool[:, 0], intent.yaw], dim=1)
        command = env.body.command(intent.move, level)
        return env.body.bound(torch.cat([command, intent.gripper[:, None]], dim=1))


def _funnel(distance: torch.Tensor, free: float, slope: float, height: float) -> torch.Tensor:
    """Height to keep at a horizontal ``distance``: 0 up to ``free``, then rising to ``height``."""
    return (slope * (distance - free)).clamp(0.0, height)


def _width(env: SymmetricTask) -> torch.Tensor:
    return env.agent.robot.get_qpos()[:, -2:].sum(dim=1)


def _yaw_to_grasp(env: SymmetricTask, cube_q: torch.Tensor) -> torch.Tensor:
    """Smallest turn ``[N]`` that aligns the fingers with two faces of the cube."""
    axis = quaternion_to_matrix(env.agent.tcp_pose.q)[:, :2, 0]
    cube = fourfold_yaw(cube_q)
    gripper = torch.atan2(axis[:, 1], axis[:, 0])
    return wrap(torch.atan2(cube[:, 1], cube[:, 0]) / 4 - gripper, math.pi / 2)


def _grasp(
    env: SymmetricTask, cube_p: torch.Tensor, cube_q: torch.Tensor, offset: torch.Tensor
) -> tuple[Intent, torch.Tensor]:
    """Approach a cube from above and close on it; also whether it is held, ``[N]`` bool."""
    tcp = env.agent.tcp_pose.p
    move = cube_p + offset - tcp
    aside = move[:, :2].norm(dim=1)
    yaw = _yaw_to_grasp(env, cube_q)
    width = _width(env)
    # The cube is 4 cm wide: fingers that stopped there around it hold it.
    around = (cube_p - tcp).norm(dim=1) < 0.03
    held = around & (width < 0.045) & (width > 0.03)
    closing = width < 0.075
    reach = torch.where(closing, 0.02, 0.008)
    ready = (aside < reach) & (move[:, 2].abs() < reach) & (yaw.abs() < 0.15) | (around & closing)
    lift = _funnel(aside, 0.012, 3.0, HOVER).maximum(_funnel(yaw.abs(), 0.12, 0.2, HOVER))
    approach = torch.cat([move[:, :2], move[:, 2:] + lift[:, None]], dim=1)
    still = ready[:, None]
    return (
        Intent(
            move=torch.where(still, torch.zeros_like(move), approach),
            yaw=torch.where(ready, torch.zeros_like(yaw), yaw),
            gripper=torch.where(ready, CLOSED, OPEN),
        ),
        held,
    )


def _choose(mask: torch.Tensor, a: Intent, b: Intent) -> Intent:
    return Intent(
        move=torch.where(mask[:, None], a.move, b.move),
        yaw=torch.where(mask, a.yaw, b.yaw),
        gripper=torch.where(mask, a.gripper, b.gripper),
    )


def _pick(env: SymmetricTask, offset: torch.Tensor) -> Intent:
    """Grasp the cube, then carry it to the goal."""
    cube = env.cube.pose
    grasp, held = _grasp(env, cube.p, cube.q, offset)
    to_goal = env.goal_site.pose.p - cube.p
    far = to_goal[:, :2].norm(dim=1)
    rise = _funnel(far, 0.02, 0.5, 0.03)
    carry = Intent(
        move=torch.cat([to_goal[:, :2], to_goal[:, 2:] + rise[:, None]], dim=1),
        yaw=torch.zeros_like(grasp.yaw),
        gripper=torch.full_like(grasp.gripper, CLOSED),
    )
    return _choose(held, carry, grasp)


def _stack(env: SymmetricTask, offset: torch.Tensor) -> Intent:
    """Grasp A, bring it above B, lower it, let go, rise."""
    a, b = env.cubeA.pose, env.cubeB.pose
    grasp, held = _grasp(env, a.p, a.q, offset)
    top = b.p - a.p
    top = torch.cat([top[:, :2], top[:, 2:] + 2 * env.cube_half_size[2]], dim=1)
    aside = top[:, :2].norm(dim=1)
    rise = _funnel(aside, 0.006, 3.0, 0.05)
    carry = Intent(
        move=torch.cat([top[:, :2], top[:, 2:] + rise[:, None]], dim=1),
        yaw=torch.zeros_like(grasp.yaw),
        gripper=torch.full_like(grasp.gripper, CLOSED),
    )
    placed = (aside < 0.012) & (top[:, 2].abs() < 0.004)
    free = placed & (_width(env) > 0.06)
    up = torch.zeros_like(top)
    up[:, 2] = torch.where(free, 0.03, 0.0)
    release = Intent(
        move=up, yaw=torch.zeros_like(grasp.yaw), gripper=torch.full_like(grasp.gripper, OPEN)
    )
    return _choose(placed, release, _choose(held, carry, grasp))


def _push(env: SymmetricTask, offset: torch.Tensor) -> Intent:
    """Close the fingers, come down behind the cube, push it towards the goal."""
    tcp, cube = env.agent.tcp_pose.p, env.obj.pose.p + offset
    to_goal = env.goal_region.pose.p[:, :2] - env.obj.pose.p[:, :2]
    ahead = to_goal / to_goal.norm(dim=1, keepdim=True).clamp_min(1e-6)
    side = torch.stack([-ahead[:, 1], ahead[:, 0]], dim=1)
    relative = tcp[:, :2] - cube[:, :2]
    along, across = (relative * ahead).sum(dim=1), (relative * side).sum(dim=1)
    # Behind the cube and near its line to the goal: go down and push, steering back to the line.
    behind = (along < -0.025) & (across.abs() < 0.02)
    start = cube[:, :2] - 0.055 * ahead - tcp[:, :2]
    lift = _funnel(start.norm(dim=1), 0.015, 3.0, HOVER)
    height = cube[:, 2] - tcp[:, 2]
    low = tcp[:, 2] < cube[:, 2] + 0.015
    pushing = behind & low
    push = 0.03 * ahead - 1.0 * across[:, None] * side
    return Intent(
        move=torch.cat(
            [
                torch.where(pushing[:, None], push, start),
                torch.where(pushing, height, height + lift)[:, None],
            ],
            dim=1,
        ),
        yaw=torch.zeros_like(along),
        gripper=torch.full_like(along, CLOSED),
    )


_INTENTS: dict[str, Callable[[SymmetricTask, torch.Tensor], Intent]] = {
    "PickCube-v1": _pick,
    "PushCube-v1": _push,
    "StackCube-v1": _stack,
}
