"""The task PushCube-v1."""

from __future__ import annotations

from typing import Any

import torch
from mani_skill.envs.tasks.tabletop.push_cube import PushCubeEnv

from symsteer.bench.tasks.move_cube import MoveCube


class PushCube(MoveCube, PushCubeEnv):
    """Push a cube into a disc on the table, in any direction.

    ManiSkill's PushCube-v1 turned by a uniform angle in every episode.

    Stock PushCube always pushes along +x, in reset and dense reward; here the direction is
    uniform (see :class:`MoveCube`). Success (cube within 10 cm of the goal, on the table) is
    ManiSkill's; the dense reward has ManiSkill's terms with its +x replaced by the direction.
    """

    task_id = "PushCube-v1"

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """Reach a point behind the cube, then bring the cube to the goal flat on the table."""
        placing = 1 - torch.tanh(5 * self._goal_distance())
        level = 1 - torch.tanh(5 * (self.obj.pose.p[:, 2] - self.cube_half_size).abs())
        gap = self._gap_behind(0.005)
        reward = 1 - torch.tanh(5 * gap) + (placing + placing * level) * (gap < 0.01)
        return torch.where(info["success"], torch.full_like(reward, 4.0), reward)
