"""The task PickCube-v1."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from mani_skill.envs.tasks.tabletop.pick_cube import PickCubeEnv
from mani_skill.utils.structs import Pose

from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.tasks.experts import CLOSED, Intent, choose, funnel, grasp
from symsteer.bench.tasks.features import GRASP_YAW, Thing, disc, flat_pose, vector_fields
from symsteer.policies.geometry import Field


class PickCube(SymmetricTask, PickCubeEnv):
    """Pick up a cube and hold it at a goal in the air.

    ManiSkill's PickCube-v1 with rotation-symmetric resets (docs/tasks/pick-cube.md).
    """

    task_id = "PickCube-v1"
    max_episode_steps = 50
    task_fields: ClassVar[tuple[Field, ...]] = (
        *vector_fields("cube"),
        Field("cube_yaw", 4),
        *vector_fields("tcp_to_cube"),
        *GRASP_YAW,
        *vector_fields("goal", "cube_to_goal"),
    )
    things: ClassVar[dict[str, Thing]] = {
        "cube": Thing("cube", turns=4),
        "goal": Thing("goal_site", "goal"),
    }
    manipulated_name = "cube"
    spawn_radius = 0.1
    spawn_extent: ClassVar[float] = 0.13
    goal_lift = 0.2

    def _place_objects(self, rng: Any, count: int) -> None:
        u = rng.uniform(size=6)
        yaw = 2 * np.pi * u[:, 2]
        self.cube.set_pose(
            flat_pose(disc(u[:, :2], self.spawn_radius), self.cube_half_size, yaw, self.device)
        )
        height = self.cube_half_size + self.goal_lift * u[:, 5:]
        goal = np.concatenate([disc(u[:, 3:5], self.spawn_radius), height], axis=1)
        self.goal_site.set_pose(
            Pose.create_from_pq(torch.as_tensor(goal, dtype=torch.float32, device=self.device))
        )

    def evaluate(self) -> dict:
        """As ManiSkill's; a ``brief`` one has only the success, which needs no contacts."""
        if not self.brief:
            return super().evaluate()
        distance = torch.linalg.norm(self.goal_site.pose.p - self.cube.pose.p, axis=1)
        return {"success": (distance <= self.goal_thresh) & self.agent.is_static(0.2)}

    def intent(self, offset: torch.Tensor) -> Intent:
        """Grasp the cube, then carry it to the goal."""
        cube = self.cube.pose
        approach, held = grasp(self, cube.p, cube.q, offset)
        to_goal = self.goal_site.pose.p - cube.p
        far = to_goal[:, :2].norm(dim=1)
        rise = funnel(far, 0.02, 0.5, 0.03)
        move = torch.cat([to_goal[:, :2], to_goal[:, 2:] + rise[:, None]], dim=1)
        return choose(held, Intent.to(move, CLOSED), approach)
