"""Push a cube into a disc on the table, in any direction."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from mani_skill.envs.tasks.tabletop.push_cube import PushCubeEnv
from mani_skill.utils.structs import Actor, Pose

from bench.tasks.base import SymmetricTask
from bench.tasks.experts import CLOSED, HOVER, Intent, funnel
from bench.tasks.features import disc, flat_pose, fourfold_yaw
from bench.tasks.rotations import quaternion_multiply, quaternion_to_matrix
from policies.geometry import Field


class PushCube(SymmetricTask, PushCubeEnv):
    """ManiSkill's PushCube-v1 turned by a uniform angle in every episode.

    Stock PushCube always pushes along +x, in reset and dense reward. Here the push direction is
    uniform on the circle: cube (spawned in a disc of 10 cm radius), its yaw, and the goal 20 cm
    ahead of it are the stock scene turned about the vertical. The goal disc's pose carries the
    direction (its body z axis), so the simulation state does too. Success (cube within 10 cm of
    the goal, on the table) is ManiSkill's; the dense reward has ManiSkill's terms with its +x
    replaced by the push direction.
    """

    task_id = "PushCube-v1"
    max_episode_steps = 50
    task_fields = (
        Field("cube_xy", 1),
        Field("cube_z", 0),
        Field("cube_yaw", 4),
        Field("tcp_to_cube_xy", 1),
        Field("tcp_to_cube_z", 0),
        Field("goal_xy", 1),
        Field("cube_to_goal_xy", 1),
        Field("tcp_to_goal_xy", 1),
    )
    spawn_radius = 0.1

    def _place_objects(self, rng: Any, count: int) -> None:
        u = rng.uniform(size=3)
        xy, yaw = disc(u[:, :2], self.spawn_radius), 2 * np.pi * u[:, 2]
        self.obj.set_pose(flat_pose(xy, self.cube_half_size, yaw, self.device))
        ahead = np.stack([np.cos(yaw), np.sin(yaw)], axis=1)
        goal = flat_pose(xy + (0.1 + self.goal_radius) * ahead, 1e-3, yaw, self.device)
        # The disc's axis is its body x axis: lay it flat, then turn it into the push direction.
        flat = goal.q.new_tensor([np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0]).expand_as(goal.q)
        self.goal_region.set_pose(Pose.create_from_pq(goal.p, quaternion_multiply(goal.q, flat)))

    @property
    def manipulated(self) -> Actor:
        """The cube."""
        return self.obj

    def push_direction(self) -> torch.Tensor:
        """Unit vectors ``[N, 2]`` from the cube's spawn point to the goal."""
        return quaternion_to_matrix(self.goal_region.pose.q)[:, :2, 2]

    def _observe_task(self) -> dict[str, torch.Tensor]:
        tcp = self.seen(self.agent.tcp_pose, "tool").p
        cube = self.seen(self.obj.pose, "object")
        goal = self.seen(self.goal_region.pose, "goal").p[:, :2]
        to_cube = cube.p - tcp
        return {
            "cube_xy": cube.p[:, :2],
            "cube_z": cube.p[:, 2:],
            "cube_yaw": fourfold_yaw(cube.q),
            "tcp_to_cube_xy": to_cube[:, :2],
            "tcp_to_cube_z": to_cube[:, 2:],
            "goal_xy": goal,
            "cube_to_goal_xy": goal - cube.p[:, :2],
            "tcp_to_goal_xy": goal - tcp[:, :2],
        }

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """Reach a point behind the cube, then bring the cube to the goal flat on the table."""
        cube = self.obj.pose.p
        behind = cube.clone()
        behind[:, :2] -= (self.cube_half_size + 0.005) * self.push_direction()
        gap = (behind - self.agent.tcp_pose.p).norm(dim=1)
        distance = (cube - self.goal_region.pose.p)[:, :2].norm(dim=1)
        placing = 1 - torch.tanh(5 * distance)
        level = 1 - torch.tanh(5 * (cube[:, 2] - self.cube_half_size).abs())
        reward = 1 - torch.tanh(5 * gap) + (placing + placing * level) * (gap < 0.01)
        return torch.where(info["success"], torch.full_like(reward, 4.0), reward)

    def intent(self, offset: torch.Tensor) -> Intent:
        """Close the fingers, come down behind the cube, push it towards the goal."""
        tcp, cube = self.agent.tcp_pose.p, self.obj.pose.p + offset
        to_goal = self.goal_region.pose.p[:, :2] - self.obj.pose.p[:, :2]
        ahead = to_goal / to_goal.norm(dim=1, keepdim=True).clamp_min(1e-6)
        side = torch.stack([-ahead[:, 1], ahead[:, 0]], dim=1)
        relative = tcp[:, :2] - cube[:, :2]
        along, across = (relative * ahead).sum(dim=1), (relative * side).sum(dim=1)
        # Behind the cube, near its line to the goal: go down and push, steering back to the line.
        behind = (along < -0.025) & (across.abs() < 0.02)
        start = cube[:, :2] - 0.055 * ahead - tcp[:, :2]
        lift = funnel(start.norm(dim=1), 0.015, 3.0, HOVER)
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
