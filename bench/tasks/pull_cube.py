"""The task PullCube-v1."""

from __future__ import annotations

from typing import Any

import torch
from mani_skill.envs.tasks.tabletop.pull_cube import PullCubeEnv

from symsteer.bench.tasks.move_cube import MoveCube


class PullCube(MoveCube, PullCubeEnv):
    """Pull a cube into a disc on the table, in any direction.

    ManiSkill's PullCube-v1 turned by a uniform angle in every episode.

    Stock PullCube always pulls along -x, towards the arm, in reset and dense reward; here the
    direction is uniform (see :class:`MoveCube`), which leaves two differences from PushCube:
    success (cube within 10 cm of the goal) does not depend on the cube's height, and the dense
    reward wants the tool 1 cm instead of 0.5 cm behind the cube. Success is ManiSkill's; the
    dense reward has ManiSkill's terms with its -x replaced by the direction.
    """

    task_id = "PullCube-v1"

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """Reach a point behind the cube, then bring the cube to the goal."""
        placing = 1 - torch.tanh(5 * self._goal_distance())
        gap = self._gap_behind(0.01)
        reward = 1 - torch.tanh(5 * gap) + placing * (gap < 0.01)
        return torch.where(info["success"], torch.full_like(reward, 3.0), reward)
