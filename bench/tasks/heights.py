"""Tasks that are seen from above: the observation has a map of heights in place of poses.

The map is what depth cameras around the workspace make together: in each pixel the height of what
stands there, metres above the table. The table and the robot are cut off (a lab knows both). It is
computed from the bodies' collision shapes, by vertical rays through each pixel: exact, and without
a Vulkan driver.

A map is a field of the layout, ``picture_height``. Quarter turns about the centre turn pixels into
pixels; other turns interpolate (:class:`symsteer.policies.picture.Picture`).
"""

from __future__ import annotations

from typing import ClassVar

import torch

from symsteer.bench.tasks.move_cube import PushCube
from symsteer.bench.tasks.pick_cube import PickCube
from symsteer.bench.tasks.solids import Scenery, pictured
from symsteer.policies.geometry import Field
from symsteer.policies.picture import PICTURE, PIXEL

SIDE = 64
"""Pixels in a row and in a column: the map shows 32 cm on each side of the centre."""

RAYS = 2
"""Rays in a row and in a column of each pixel, whose heights are averaged."""


class Above(Scenery):
    """Mixin; list it before the class of a task whose bodies are seen from above."""

    def _observe_task(self) -> dict[str, torch.Tensor]:
        return {**super()._observe_task(), f"{PICTURE}height": self.heights().flatten(1)}

    def heights(self) -> torch.Tensor:
        """The present map, ``[N, SIDE, SIDE]`` metres; rows from +y to -y."""
        rays = SIDE * RAYS
        line = (torch.arange(rays, device=self.device) + 0.5) * (PIXEL / RAYS) - SIDE * PIXEL / 2
        found = torch.zeros(self.num_envs, rays, rays, device=self.device)
        ground, one = found.new_zeros(1, 1, 1), found.new_ones(1, 1, 1)
        upwards = self.spans(
            (line[None, None], -line[None, :, None], ground), (ground, ground, one)
        )
        for _, top in upwards:
            found = torch.maximum(found, top)
        return torch.nn.functional.avg_pool2d(found, RAYS)


class HeightPushCube(Above, PushCube):
    """Push a cube that a map of heights shows into a disc on the table, in any direction."""

    task_id = "HeightPushCube-v1"
    task_fields: ClassVar[tuple[Field, ...]] = pictured(
        f"{PICTURE}height", SIDE, PushCube, "goal_xy", "tcp_to_goal_xy"
    )


class HeightPickCube(Above, PickCube):
    """Pick up a cube that a map of heights shows, and hold it at a goal in the air."""

    task_id = "HeightPickCube-v1"
    task_fields: ClassVar[tuple[Field, ...]] = pictured(
        f"{PICTURE}height", SIDE, PickCube, "goal_xy", "goal_z"
    )
