"""The task PokeCube-v1."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
import torch
from mani_skill.envs.tasks.tabletop.poke_cube import PokeCubeEnv

from symsteer.bench.sim.rotations import quaternion_to_matrix, wrap
from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.tasks.experts import CLOSED, OPEN, Intent, choose, funnel, grasp_at, yaw_along
from symsteer.bench.tasks.features import (
    GRASP_YAW,
    Thing,
    ahead_of,
    disc,
    flat_pose,
    goal_disc_pose,
    left_of,
    vector_fields,
)
from symsteer.policies.geometry import Field


class PokeCube(SymmetricTask, PokeCubeEnv):
    """Poke a cube into a disc on the table with a peg, in any direction.

    ManiSkill's PokeCube-v1 turned by a uniform angle in every episode, with two quantities of its
    dense reward that pin the world's axes replaced (docs/tasks/poke-cube.md). The goal disc's pose
    carries the direction (its body z axis). The peg is its own image under a half turn, colours
    included; ManiSkill calls its end at the frame's +x the head, which faces the cube at a reset.
    """

    task_id = "PokeCube-v1"
    max_episode_steps = 60
    task_fields = (
        *vector_fields("peg"),
        Field("peg_yaw", 2),
        *vector_fields("tcp_to_peg"),
        *GRASP_YAW,
        *vector_fields("cube"),
        Field("cube_yaw", 4),
        Field("peg_end_to_cube_xy", 1),
        Field("goal_xy", 1),
        Field("cube_to_goal_xy", 1),
    )
    things: ClassVar[dict[str, Thing]] = {
        "peg": Thing("peg", turns=2),
        "cube": Thing("cube", turns=4),
        "goal": Thing("goal_region", "goal"),
    }
    manipulated_name = "cube"
    spawn_radius = 0.05
    peg_behind = 0.07
    peg_to_cube = 0.22
    across = 0.1
    cube_turn = math.pi / 6
    spawn_extent = 0.26
    noise_scale = 0.7

    def _place_objects(self, rng: Any, count: int) -> None:
        u = rng.uniform(size=5)
        middle, yaw = disc(u[:, :2], self.spawn_radius), 2 * np.pi * u[:, 2]
        ahead = ahead_of(yaw)
        aside = self.across * (u[:, 3:4] - 0.5) * left_of(ahead)
        peg = middle - self.peg_behind * ahead - aside
        cube = middle + (self.peg_to_cube - self.peg_behind) * ahead + aside
        self.peg.set_pose(flat_pose(peg, self.peg_half_width, yaw, self.device))
        turn = self.cube_turn * (2 * u[:, 4] - 1)
        self.cube.set_pose(flat_pose(cube, self.cube_half_size, yaw + turn, self.device))
        goal = cube + (0.05 + self.goal_radius) * ahead
        self.goal_region.set_pose(goal_disc_pose(goal, yaw, self.device))

    @property
    def peg_head_pos(self) -> torch.Tensor:
        """Where the head of the peg is, ``[N, 3]`` metres."""
        return self.peg_head_pose.p

    def evaluate(self) -> dict[str, torch.Tensor]:
        """ManiSkill's, with an angle between peg and cube that is right for any yaw."""
        info = super().evaluate()
        peg, cube = (quaternion_to_matrix(b.pose.q)[:, :2, 0] for b in (self.peg, self.cube))
        yaw = torch.atan2(peg[:, 1], peg[:, 0]) - torch.atan2(cube[:, 1], cube[:, 0])
        info["angle_diff"] = wrap(yaw, math.pi / 2).abs()
        close = info["head_to_cube_dist"] <= self.cube_half_size + 0.005
        info["is_peg_cube_fit"] = (info["angle_diff"] < 0.05) & close
        return info

    def _observe_task(self) -> dict[str, torch.Tensor]:
        peg, cube = (self.seen(body.pose, "object") for body in (self.peg, self.cube))
        peg_to_cube = cube.p - peg.p
        end = self._half_peg(quaternion_to_matrix(peg.q)[:, :, 0], peg_to_cube)
        return {**super()._observe_task(), "peg_end_to_cube_xy": (peg_to_cube - end)[:, :2]}

    def _half_peg(self, axis: torch.Tensor, towards: torch.Tensor) -> torch.Tensor:
        """From the peg's middle to its end on the side of ``towards [N, 3]``, ``[N, 3]``."""
        same_side = (axis * towards).sum(dim=1, keepdim=True) >= 0
        return self.peg_half_length * torch.where(same_side, axis, -axis)

    def intent(self, offset: torch.Tensor) -> Intent:
        """Grasp the peg by its middle, bring it behind the cube, poke, let go."""
        tcp, peg, cube = self.agent.tcp_pose.p, self.peg.pose, self.cube.pose.p
        to_goal = (self.goal_region.pose.p - cube)[:, :2]
        distance = to_goal.norm(dim=1)
        ahead = to_goal / distance[:, None].clamp_min(1e-6)
        side = left_of(ahead)

        axis = quaternion_to_matrix(peg.q)[:, :, 0]
        # Where the fingers are along the peg.
        slide = ((tcp - peg.p) * axis).sum(dim=1, keepdim=True)
        here = peg.p + slide.clamp(-self.peg_half_length, self.peg_half_length) * axis
        # The fingers have 15 mm on either side of the peg, less than the largest offset: most of
        # the offset moves the grasp along the peg.
        along_peg = (offset * axis).sum(dim=1, keepdim=True) * axis
        target = peg.p + along_peg + 0.3 * (offset - along_peg)
        straddle = yaw_along(self, axis[:, :2])
        approach, held = grasp_at(self, target, here, straddle, 2 * self.peg_half_width)

        end = peg.p + self._half_peg(axis, torch.cat([ahead, 0 * ahead[:, :1]], dim=1))
        pointing = (end - peg.p)[:, :2]
        turn = torch.atan2((pointing * side).sum(dim=1), (pointing * ahead).sum(dim=1))
        # The peg turns about the fingers: where its end will be once it points ahead.
        lever = (end - here).norm(dim=1)
        relative = (here - cube)[:, :2]
        along = (relative * ahead).sum(dim=1) + lever
        across = (relative * side).sum(dim=1)
        back = funnel(across.abs(), 0.008, 3.0, 0.06).maximum(funnel(turn.abs(), 0.06, 0.5, 0.06))
        lined_up = back <= 0.0
        gap = (-along - self.cube_half_size).clamp_min(0.0)
        forward = (gap + 0.5 * (distance - 0.02)).clamp(0.0, 0.03)
        retreat = -(self.cube_half_size + 0.015) - back - along
        move = torch.where(lined_up, forward, retreat)[:, None] * ahead - across[:, None] * side
        lift = self.peg_half_width + 0.005 - peg.p[:, 2:]
        poke = Intent.to(torch.cat([move, lift], dim=1), CLOSED, -turn)
        # Let go: a hand that squeezes a peg is not quite at rest.
        stand = Intent.to(torch.zeros_like(tcp), OPEN)
        return choose(distance < 0.045, stand, choose(held, poke, approach))
