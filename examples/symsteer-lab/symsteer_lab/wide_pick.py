"""The task WidePick-v1."""

from __future__ import annotations

import torch

from symsteer.bench import PickCube
from symsteer.policies import Field


class WidePick(PickCube):
    """PickCube on a larger disc, with the cube's distance from its goal in the observation.

    Reset: as PickCube, but cube and goal lie in a disc of 15 cm radius (PickCube: 10 cm).
    """

    task_id = "WidePick-v1"
    max_episode_steps = 60
    task_fields = (*PickCube.task_fields, Field("goal_distance", 0))
    spawn_radius = 0.15
    spawn_extent = 0.18

    def _observe_task(self) -> dict[str, torch.Tensor]:
        fields = super()._observe_task()
        to_goal = torch.cat([fields["cube_to_goal_xy"], fields["cube_to_goal_z"]], dim=1)
        return {**fields, "goal_distance": to_goal.norm(dim=1, keepdim=True)}
