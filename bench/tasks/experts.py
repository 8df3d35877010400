"""Scripted experts for all environments at once.

A task's ``intent`` is a function of the present state: where to move the tool centre point, how
to turn it, and whether to close the fingers. It uses relative vectors, heights and yaw differences
only, so rotating a state rotates its action. The phase follows from the geometry, not from a
counter, so that it can be inferred from the state. Phases are joined by funnels: the further the
gripper is from the axis of a grasp, the higher it stays. This module holds the parts that several
tasks use, and :class:`Expert`, which turns an intent into an action.

An offset [N, 3] moves the point that is grasped or pushed; diverse demonstrations use it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch

from symsteer.bench.sim.rotations import quaternion_to_matrix, wrap
from symsteer.bench.tasks.features import left_of, yaw_up_to

if TYPE_CHECKING:
    from symsteer.bench.tasks.base import SymmetricTask

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

    @classmethod
    def to(cls, move: torch.Tensor, gripper: float, yaw: torch.Tensor | None = None) -> Intent:
        """Move by ``move [N, 3]`` with the same fingers everywhere; by default without a turn."""
        still = torch.zeros_like(move[:, 0])
        return cls(move, still if yaw is None else yaw, torch.full_like(still, gripper))

    @classmethod
    def to_let_go(cls, free: torch.Tensor) -> Intent:
        """Open the fingers, and rise by 3 cm where they are ``free [N]`` of the object."""
        up = torch.zeros(len(free), 3, device=free.device)
        up[:, 2] = torch.where(free, 0.03, 0.0)
        return cls.to(up, OPEN)


class Expert:
    """Solves a task from its privileged state.

    Args:
        env: a task made by ``symsteer.make``, with any embodiment.
    """

    def __init__(self, env: SymmetricTask):
        self.env = env
        self.offset = torch.zeros(env.num_envs, 3, device=env.device)

    def act(self, noise: torch.Tensor | None = None) -> torch.Tensor:
        """The action for the present state as ``env.step`` takes it, ``[N, 7]``, bounded.

        Args:
            noise: added to the expert's bounded action, ``[N, 7]``.
        """
        env = self.env
        intent = env.intent(self.offset)
        tool = quaternion_to_matrix(env.agent.tcp_pose.q)[:, :, 2]
        # Turning by tool x down brings the tool axis back to straight down.
        level = torch.stack([-tool[:, 1], tool[:, 0], intent.yaw], dim=1)
        command = env.body.command(intent.move, level)
        action = env.body.bound(torch.cat([command, intent.gripper[:, None]], dim=1))
        if noise is not None:
            action = env.body.bound(action + noise)
        return env.commanded(action)


def funnel(distance: torch.Tensor, free: float, slope: float, height: float) -> torch.Tensor:
    """Height to keep at a horizontal ``distance``: 0 up to ``free``, then rising to ``height``."""
    return (slope * (distance - free)).clamp(0.0, height)


def finger_width(env: SymmetricTask) -> torch.Tensor:
    """Opening between the fingers, ``[N]`` metres."""
    return env.agent.robot.get_qpos()[:, -2:].sum(dim=1)


def yaw_along(
    env: SymmetricTask, axis: torch.Tensor, later: torch.Tensor | None = None
) -> torch.Tensor:
    """Turn ``[N]`` that sets the fingers on both sides of a bar along ``axis [N, 2]``.

    The smallest one that the joints can reach, also if they turn by ``later [N]`` afterwards.
    """
    yaw = _turn_to(env, torch.atan2(axis[:, 1], axis[:, 0]), math.pi)
    later = torch.zeros_like(yaw) if later is None else later
    return env.body.reachable_turn(env.agent.robot.get_qpos(), yaw, later)


def _turn_to(env: SymmetricTask, yaw: torch.Tensor, period: float) -> torch.Tensor:
    """Smallest turn ``[N]`` of the fingers to ``yaw [N]``, or to one that differs by a period."""
    hand = quaternion_to_matrix(env.agent.tcp_pose.q)[:, :2, 0]
    return wrap(yaw - torch.atan2(hand[:, 1], hand[:, 0]), period)


def grasp(
    env: SymmetricTask, cube_p: torch.Tensor, cube_q: torch.Tensor, offset: torch.Tensor
) -> tuple[Intent, torch.Tensor]:
    """Approach a cube from above and close on it; also whether it is held, ``[N]`` bool."""
    faces = yaw_up_to(4, cube_q)
    turn = _turn_to(env, torch.atan2(faces[:, 1], faces[:, 0]) / 4, math.pi / 2)
    return grasp_at(env, cube_p + offset, cube_p, turn, 0.04)


def grasp_at(
    env: SymmetricTask,
    target: torch.Tensor,
    body: torch.Tensor,
    yaw: torch.Tensor,
    width: float,
    haste: float = 1.0,
) -> tuple[Intent, torch.Tensor]:
    """Come down on a point and close the fingers; also say whether the object is held, ``[N]``.

    Args:
        env: the task.
        target: where the tool centre point should be when the fingers close, ``[N, 3]``.
        body: the point of the object that must be near for it to be held, ``[N, 3]``.
        yaw: turn that aligns the fingers, ``[N]``; zeros if every yaw is right.
        width: of the object between the fingers, metres.
        haste: share of the last 4 cm that is commanded in one step; smaller is slower and more
            precise.
    """
    tcp = env.agent.tcp_pose.p
    move = target - tcp
    aside = move[:, :2].norm(dim=1)
    opening = finger_width(env)
    # Fingers that stopped at the object's width around it hold it.
    around = (body - tcp).norm(dim=1) < 0.03
    held = around & (opening < width + 0.005) & (opening > width - 0.01)
    closing = opening < 0.075
    reach = torch.where(closing, 0.02, 0.008)
    ready = (aside < reach) & (move[:, 2].abs() < reach) & (yaw.abs() < 0.15) | (around & closing)
    lift = funnel(aside, 0.012, 3.0, HOVER).maximum(funnel(yaw.abs(), 0.12, 0.2, HOVER))
    approach = torch.cat([move[:, :2], move[:, 2:] + lift[:, None]], dim=1)
    if haste != 1.0:
        last = approach.norm(dim=1, keepdim=True) < 0.04
        approach = torch.where(last, haste * approach, approach)
    still = ready[:, None]
    return (
        Intent(
            move=torch.where(still, torch.zeros_like(move), approach),
            yaw=torch.where(ready, torch.zeros_like(yaw), yaw),
            gripper=torch.where(ready, CLOSED, OPEN),
        ),
        held,
    )


def push(
    env: SymmetricTask,
    cube: torch.Tensor,
    ahead: torch.Tensor,
    behind: float = 0.055,
    step: float | torch.Tensor = 0.03,
) -> Intent:
    """Close the fingers, come down behind a cube and push it, steering back to its line.

    Args:
        env: the task.
        cube: the centre of a cube of 4 cm on the table, ``[N, 3]``.
        ahead: unit vectors into the direction of the push, ``[N, 2]``.
        behind: where the tool comes down, metres behind the centre.
        step: how far to push in this control step, metres, or ``[N, 1]``.
    """
    tcp, side = env.agent.tcp_pose.p, left_of(ahead)
    relative = tcp[:, :2] - cube[:, :2]
    along, across = (relative * ahead).sum(dim=1), (relative * side).sum(dim=1)
    # Behind the cube, near its line: go down and push.
    placed = (along < -0.025) & (across.abs() < 0.02)
    start = cube[:, :2] - behind * ahead - tcp[:, :2]
    lift = funnel(start.norm(dim=1), 0.015, 3.0, HOVER)
    height = cube[:, 2] - tcp[:, 2]
    low = tcp[:, 2] < cube[:, 2] + 0.015
    pushing = placed & low
    level = torch.where(pushing[:, None], step * ahead - 1.0 * across[:, None] * side, start)
    rise = torch.where(pushing, height, height + lift)
    return Intent.to(torch.cat([level, rise[:, None]], dim=1), CLOSED)


def choose(mask: torch.Tensor, a: Intent, b: Intent) -> Intent:
    """``a`` where ``mask [N]`` holds, ``b`` elsewhere."""
    return Intent(
        move=torch.where(mask[:, None], a.move, b.move),
        yaw=torch.where(mask, a.yaw, b.yaw),
        gripper=torch.where(mask, a.gripper, b.gripper),
    )
