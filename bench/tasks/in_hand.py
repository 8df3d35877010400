"""Tasks that a camera in the hand sees: the observation has its picture in place of poses.

The camera is fixed to the gripper and looks along the tool. Each pixel has the distance to the body
that its ray meets first. Table and robot are cut off (a lab knows both): 0 where there is nothing
else. It is computed from the bodies' collision shapes: exact, and without a Vulkan driver.

A picture is a field of the layout, ``hand_distance``. It does not change when scene and hand turn
together; how the hand is turned is told beside it, by the tool's axes.
"""

from __future__ import annotations

from typing import ClassVar

import torch

from symsteer.bench.sim.rotations import quaternion_to_matrix
from symsteer.bench.tasks.move_cube import PushCube
from symsteer.bench.tasks.pick_cube import PickCube
from symsteer.bench.tasks.solids import Scenery, pictured
from symsteer.policies.geometry import Field
from symsteer.policies.picture import HAND, hand_rays

SIDE = 64
"""Pixels in a row and in a column."""

MOUNT = (0.0465, 0.0, -0.0674)
"""The camera's place in the tool's axes, metres from the tool centre point: that of ManiSkill's
Panda with a wrist camera, but in the plane across which the hand is its own mirror image."""


class InHand(Scenery):
    """Mixin; list it before the class of a task whose bodies a camera in the hand sees."""

    def _observe_task(self) -> dict[str, torch.Tensor]:
        return {**super()._observe_task(), f"{HAND}distance": self.distances().flatten(1)}

    def distances(self) -> torch.Tensor:
        """The present picture, ``[N, SIDE, SIDE]`` metres; rows from the tool's +x to -x."""
        tool = self.seen(self.agent.tcp_pose, "tool")
        axes = quaternion_to_matrix(tool.q)
        # Sums of columns: a matrix product may round differently for another N.
        mount, rays = torch.tensor(MOUNT).to(axes), hand_rays(SIDE).to(axes)
        origin = (tool.p + (axes * mount).sum(2))[:, None]
        direction = (axes[:, None] * rays[:, None]).sum(3)
        found = direction.new_full(direction.shape[:2], torch.inf)
        for near, far in self.spans(origin.unbind(2), direction.unbind(2)):
            found = torch.where(far > 0, torch.minimum(found, near.clamp_min(0)), found)
        return found.where(found.isfinite(), 0.0).unflatten(1, (SIDE, SIDE))


class HandPushCube(InHand, PushCube):
    """Push a cube that a camera in the hand sees into a disc on the table, in any direction."""

    task_id = "HandPushCube-v1"
    task_fields: ClassVar[tuple[Field, ...]] = pictured(
        f"{HAND}distance", SIDE, PushCube, "goal_xy", "tcp_to_goal_xy"
    )


class HandPickCube(InHand, PickCube):
    """Pick up a cube that a camera in the hand sees, and hold it at a goal in the air."""

    task_id = "HandPickCube-v1"
    task_fields: ClassVar[tuple[Field, ...]] = pictured(
        f"{HAND}distance", SIDE, PickCube, "goal_xy", "goal_z"
    )
