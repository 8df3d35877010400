"""The task PickCube-v1."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from mani_skill.envs.tasks.tabletop.pick_cube import PickCubeEnv
from mani_skill.utils.structs import Actor, Pose

from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.tasks.experts import CLOSED, Intent, choose, funnel, grasp
from symsteer.bench.tasks.features import disc, flat_pose, fourfold_yaw, grasp_yaw
from symsteer.policies.geometry import Field


class PickCube(SymmetricTask, PickCubeEnv):
    """Pick up a cube and hold it at a goal in the air.

    ManiSkill's PickCube-v1 with rotation-symmetric resets.

    Reset: cube uniform in a disc of 10 cm radius about the centre with uniform yaw; goal uniform
    in a disc of 10 cm radius, 0 to 20 cm above the cube's resting height (stock: squares, 0 to
    30 cm). Success (goal within 2.5 cm, robot static) and reward are ManiSkill's.
    """

    task_id = "PickCube-v1"
    max_episode_steps = 50
    task_fields: ClassVar[tuple[Field, ...]] = (
        Field("cube_xy", 1),
        Field("cube_z", 0),
        Field("cube_yaw", 4),
        Field("tcp_to_cube_xy", 1),
        Field("tcp_to_cube_z", 0),
        Field("grasp_yaw_cos", 0),
        Field("grasp_yaw_sin", 0, odd=True),
        Field("goal_xy", 1),
        Field("goal_z", 0),
        Field("cube_to_goal_xy", 1),
        Field("cube_to_goal_z", 0),
    )
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

    @property
    def manipulated(self) -> Actor:
        """The cube."""
        return self.cube

    def _observe_task(self) -> dict[str, torch.Tensor]:
        tcp = self.seen(self.agent.tcp_pose, "tool")
        cube = self.seen(self.cube.pose, "object")
        goal = self.seen(self.goal_site.pose, "goal").p
        to_cube, to_goal = cube.p - tcp.p, goal - cube.p
        return {
            "cube_xy": cube.p[:, :2],
            "cube_z": cube.p[:, 2:],
            "cube_yaw": fourfold_yaw(cube.q),
            "tcp_to_cube_xy": to_cube[:, :2],
            "tcp_to_cube_z": to_cube[:, 2:],
            **grasp_yaw(tcp.q, cube.q),
            "goal_xy": goal[:, :2],
            "goal_z": goal[:, 2:],
            "cube_to_goal_xy": to_goal[:, :2],
            "cube_to_goal_z": to_goal[:, 2:],
        }

    def intent(self, offset: torch.Tensor) -> Intent:
        """Grasp the cube, then carry it to the goal."""
        cube = self.cube.pose
        approach, held = grasp(self, cube.p, cube.q, offset)
        to_goal = self.goal_site.pose.p - cube.p
        far = to_goal[:, :2].norm(dim=1)
        rise = funnel(far, 0.02, 0.5, 0.03)
        carry = Intent(
            move=torch.cat([to_goal[:, :2], to_goal[:, 2:] + rise[:, None]], dim=1),
            yaw=torch.zeros_like(approach.yaw),
            gripper=torch.full_like(approach.gripper, CLOSED),
        )
        return choose(held, carry, approach)
