"""The tasks PushCube-v1 and PullCube-v1: a cube on the table, a goal disc 20 cm away from it."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from mani_skill.envs.tasks.tabletop.pull_cube import PullCubeEnv
from mani_skill.envs.tasks.tabletop.push_cube import PushCubeEnv
from mani_skill.utils.structs import Actor

from symsteer.bench.sim.rotations import quaternion_to_matrix
from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.tasks.experts import Intent, push
from symsteer.bench.tasks.features import (
    Thing,
    ahead_of,
    disc,
    flat_pose,
    goal_disc_pose,
    vector_fields,
)
from symsteer.policies.geometry import Field


class MoveCube(SymmetricTask):
    """A cube that closed fingers move over the table into a goal disc, in any direction.

    Reset: cube uniform in a disc of 10 cm radius about the centre; direction uniform on the
    circle; the cube's yaw is that direction and the goal lies 20 cm ahead, as in the stock
    scenes, turned about the vertical. The goal disc's pose carries the direction (its body z
    axis), so the simulation state does too.
    """

    task_fields: ClassVar[tuple[Field, ...]] = (
        *vector_fields("cube"),
        Field("cube_yaw", 4),
        *vector_fields("tcp_to_cube"),
        Field("goal_xy", 1),
        Field("cube_to_goal_xy", 1),
        Field("tcp_to_goal_xy", 1),
    )
    max_episode_steps = 50
    things: ClassVar[dict[str, Thing]] = {
        "cube": Thing("obj", turns=4),
        "goal": Thing("goal_region", "goal"),
    }
    manipulated_name = "obj"
    spawn_radius = 0.1
    spawn_extent = 0.13

    gap: ClassVar[float]
    """Where the dense reward wants the tool, metres behind the cube."""
    flat_on_the_table: ClassVar[bool]
    """Whether the dense reward has a term for the cube's height."""

    obj: Actor
    goal_region: Actor
    cube_half_size: float
    goal_radius: float

    def _place_objects(self, rng: Any, count: int) -> None:
        u = rng.uniform(size=3)
        xy, yaw = disc(u[:, :2], self.spawn_radius), 2 * np.pi * u[:, 2]
        self.obj.set_pose(flat_pose(xy, self.cube_half_size, yaw, self.device))
        goal = xy + (0.1 + self.goal_radius) * ahead_of(yaw)
        self.goal_region.set_pose(goal_disc_pose(goal, yaw, self.device))

    def direction(self) -> torch.Tensor:
        """Unit vectors ``[N, 2]`` from the cube's spawn point to the goal."""
        return quaternion_to_matrix(self.goal_region.pose.q)[:, :2, 2]

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """Reach a point behind the cube, then bring the cube to the goal.

        ManiSkill's terms with its +x replaced by the direction.
        """
        cube = self.obj.pose.p
        behind = cube.clone()
        behind[:, :2] -= (self.cube_half_size + self.gap) * self.direction()
        gap = (behind - self.agent.tcp_pose.p).norm(dim=1)
        distance = (cube - self.goal_region.pose.p)[:, :2].norm(dim=1)
        placing = 1 - torch.tanh(5 * distance)
        if self.flat_on_the_table:
            level = 1 - torch.tanh(5 * (cube[:, 2] - self.cube_half_size).abs())
            placing = placing + placing * level
        reward = 1 - torch.tanh(5 * gap) + placing * (gap < 0.01)
        highest = 4.0 if self.flat_on_the_table else 3.0
        return torch.where(info["success"], torch.full_like(reward, highest), reward)

    def intent(self, offset: torch.Tensor) -> Intent:
        """Close the fingers, come down behind the cube, push it towards the goal."""
        to_goal = self.goal_region.pose.p[:, :2] - self.obj.pose.p[:, :2]
        ahead = to_goal / to_goal.norm(dim=1, keepdim=True).clamp_min(1e-6)
        return push(self, self.obj.pose.p + offset, ahead)


class PushCube(MoveCube, PushCubeEnv):
    """Push a cube into a disc on the table, in any direction.

    ManiSkill's PushCube-v1 turned by a uniform angle in every episode (docs/tasks/push-cube.md).
    """

    task_id = "PushCube-v1"
    gap = 0.005
    flat_on_the_table = True


class PullCube(MoveCube, PullCubeEnv):
    """Pull a cube into a disc on the table, in any direction.

    ManiSkill's PullCube-v1 turned by a uniform angle in every episode (docs/tasks/pull-cube.md).
    Two differences from PushCube remain: success does not depend on the cube's height, and the
    dense reward wants the tool 1 cm instead of 0.5 cm behind the cube.
    """

    task_id = "PullCube-v1"
    gap = 0.01
    flat_on_the_table = False
