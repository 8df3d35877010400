"""The task StackCube-v1."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from mani_skill.envs.tasks.tabletop.stack_cube import StackCubeEnv

from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.tasks.experts import CLOSED, Intent, choose, finger_width, funnel, grasp
from symsteer.bench.tasks.features import GRASP_YAW, Thing, flat_pose, pair, vector_fields
from symsteer.policies.geometry import Field


class StackCube(SymmetricTask, StackCubeEnv):
    """Stack one cube on another and let go.

    ManiSkill's StackCube-v1 with rotation-symmetric resets (docs/tasks/stack-cube.md).
    """

    task_id = "StackCube-v1"
    max_episode_steps = 60
    task_fields = (
        *vector_fields("cube_a"),
        Field("cube_a_yaw", 4),
        *vector_fields("cube_b"),
        Field("cube_b_yaw", 4),
        *vector_fields("tcp_to_a"),
        *GRASP_YAW,
        *vector_fields("a_to_b"),
    )
    things: ClassVar[dict[str, Thing]] = {
        **dict.fromkeys(("cube_a", "a"), Thing("cubeA", turns=4)),
        **dict.fromkeys(("cube_b", "b"), Thing("cubeB", turns=4)),
    }
    manipulated_name = "cubeA"
    spawn_radius = 0.07
    spawn_extent: ClassVar[float] = 0.18
    distance_range = (0.08, 0.16)

    def _place_objects(self, rng: Any, count: int) -> None:
        u = rng.uniform(size=6)
        at_a, at_b = pair(u, self.spawn_radius, self.distance_range)
        height = float(self.cube_half_size[2])
        self.cubeA.set_pose(flat_pose(at_a, height, 2 * np.pi * u[:, 4], self.device))
        self.cubeB.set_pose(flat_pose(at_b, height, 2 * np.pi * u[:, 5], self.device))

    def intent(self, offset: torch.Tensor) -> Intent:
        """Grasp A, bring it above B, lower it, let go, rise."""
        a, b = self.cubeA.pose, self.cubeB.pose
        approach, held = grasp(self, a.p, a.q, offset)
        top = b.p - a.p
        top = torch.cat([top[:, :2], top[:, 2:] + 2 * self.cube_half_size[2]], dim=1)
        aside = top[:, :2].norm(dim=1)
        rise = funnel(aside, 0.006, 3.0, 0.05)
        carry = Intent.to(torch.cat([top[:, :2], top[:, 2:] + rise[:, None]], dim=1), CLOSED)
        placed = (aside < 0.012) & (top[:, 2].abs() < 0.004)
        release = Intent.to_let_go(placed & (finger_width(self) > 0.06))
        return choose(placed, release, choose(held, carry, approach))
