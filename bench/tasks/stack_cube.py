"""The task StackCube-v1."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from mani_skill.envs.tasks.tabletop.stack_cube import StackCubeEnv
from mani_skill.utils.structs import Actor

from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.tasks.experts import CLOSED, OPEN, Intent, choose, finger_width, funnel, grasp
from symsteer.bench.tasks.features import disc, flat_pose, fourfold_yaw, grasp_yaw
from symsteer.policies.geometry import Field


class StackCube(SymmetricTask, StackCubeEnv):
    """Stack one cube on another and let go.

    ManiSkill's StackCube-v1 with rotation-symmetric resets.

    Reset: the midpoint of the two cubes is uniform in a disc of 7 cm radius about the centre,
    their bearing uniform on the circle, their distance uniform in 8 to 16 cm, both yaws uniform.
    Success (A rests on B, let go) and reward are ManiSkill's.
    """

    task_id = "StackCube-v1"
    max_episode_steps = 60
    task_fields = (
        Field("cube_a_xy", 1),
        Field("cube_a_z", 0),
        Field("cube_a_yaw", 4),
        Field("cube_b_xy", 1),
        Field("cube_b_z", 0),
        Field("cube_b_yaw", 4),
        Field("tcp_to_a_xy", 1),
        Field("tcp_to_a_z", 0),
        Field("grasp_yaw_cos", 0),
        Field("grasp_yaw_sin", 0, odd=True),
        Field("a_to_b_xy", 1),
        Field("a_to_b_z", 0),
    )
    spawn_radius = 0.07
    spawn_extent: ClassVar[float] = 0.18
    distance_range = (0.08, 0.16)

    def _place_objects(self, rng: Any, count: int) -> None:
        u = rng.uniform(size=6)
        middle, bearing = disc(u[:, :2], self.spawn_radius), 2 * np.pi * u[:, 2]
        low, high = self.distance_range
        half = (low + (high - low) * u[:, 3]) / 2
        offset = half[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=1)
        height = float(self.cube_half_size[2])
        yaw_a, yaw_b = 2 * np.pi * u[:, 4], 2 * np.pi * u[:, 5]
        self.cubeA.set_pose(flat_pose(middle + offset, height, yaw_a, self.device))
        self.cubeB.set_pose(flat_pose(middle - offset, height, yaw_b, self.device))

    @property
    def manipulated(self) -> Actor:
        """The cube that is stacked."""
        return self.cubeA

    def _observe_task(self) -> dict[str, torch.Tensor]:
        tcp = self.seen(self.agent.tcp_pose, "tool")
        a, b = self.seen(self.cubeA.pose, "object"), self.seen(self.cubeB.pose, "object")
        to_a, a_to_b = a.p - tcp.p, b.p - a.p
        return {
            "cube_a_xy": a.p[:, :2],
            "cube_a_z": a.p[:, 2:],
            "cube_a_yaw": fourfold_yaw(a.q),
            "cube_b_xy": b.p[:, :2],
            "cube_b_z": b.p[:, 2:],
            "cube_b_yaw": fourfold_yaw(b.q),
            "tcp_to_a_xy": to_a[:, :2],
            "tcp_to_a_z": to_a[:, 2:],
            **grasp_yaw(tcp.q, a.q),
            "a_to_b_xy": a_to_b[:, :2],
            "a_to_b_z": a_to_b[:, 2:],
        }

    def intent(self, offset: torch.Tensor) -> Intent:
        """Grasp A, bring it above B, lower it, let go, rise."""
        a, b = self.cubeA.pose, self.cubeB.pose
        approach, held = grasp(self, a.p, a.q, offset)
        top = b.p - a.p
        top = torch.cat([top[:, :2], top[:, 2:] + 2 * self.cube_half_size[2]], dim=1)
        aside = top[:, :2].norm(dim=1)
        rise = funnel(aside, 0.006, 3.0, 0.05)
        carry = Intent(
            move=torch.cat([top[:, :2], top[:, 2:] + rise[:, None]], dim=1),
            yaw=torch.zeros_like(approach.yaw),
            gripper=torch.full_like(approach.gripper, CLOSED),
        )
        placed = (aside < 0.012) & (top[:, 2].abs() < 0.004)
        free = placed & (finger_width(self) > 0.06)
        up = torch.zeros_like(top)
        up[:, 2] = torch.where(free, 0.03, 0.0)
        release = Intent(
            move=up,
            yaw=torch.zeros_like(approach.yaw),
            gripper=torch.full_like(approach.gripper, OPEN),
        )
        return choose(placed, release, choose(held, carry, approach))
