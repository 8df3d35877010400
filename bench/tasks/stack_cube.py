"""Stack one cube on another and let go."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from mani_skill.envs.tasks.tabletop.stack_cube import StackCubeEnv

from bench.tasks.base import SymmetricTask, disc, flat_pose, fourfold_yaw, grasp_yaw
from policies.geometry import Field


class StackCube(SymmetricTask, StackCubeEnv):
    """ManiSkill's StackCube-v1 with rotation-symmetric resets.

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

    def _observe_task(self) -> dict[str, torch.Tensor]:
        tcp, a, b = self.agent.tcp_pose, self.cubeA.pose, self.cubeB.pose
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
