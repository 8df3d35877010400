"""Training episodes begin in a wedge of the table."""

from __future__ import annotations

import torch
from mani_skill.utils.structs import Pose

from symsteer.bench.sim.rotations import quaternion_multiply, yaw_quaternion
from symsteer.bench.variants.base import Variant
from symsteer.policies.geometry import Field, Layout

POINT = Layout([Field("xy", 1), Field("z", 0)])


class SpawnSector(Variant):
    """The manipulated object starts in a wedge about +x: all around at strength 0, 45 degrees at 1.

    The freshly placed scene (objects and goals, not the robot) is turned as a whole about the
    workspace's centre, such that the object's bearing b becomes b (1 - 7/8 strength): uniform on
    a wedge of 360 - 315 * strength degrees. Dynamics, reward and observation are untouched, and
    evaluation draws from the full disc (``training_only``).
    Breaks the initial states, everywhere; the mirror image in the x axis survives.
    """

    training_only = True

    def reset(self, env_idx: torch.Tensor) -> None:
        env = self.env
        center = torch.tensor([*env.workspace_center, 0.0], device=env.device)
        p = env.manipulated.pose.p[env_idx] - center
        turn = -7 / 8 * self.amount[env_idx] * torch.atan2(p[:, 1], p[:, 0])
        active = self.active[env_idx][:, None]
        furniture = env.table_scene.table
        for body in env.scene.actors.values():
            if body.px_body_type == "static" or body is furniture:
                continue
            p, q = body.pose.p[env_idx], body.pose.q[env_idx]
            turned = center + POINT.rotate(p - center, turn)
            body.set_pose(
                Pose.create_from_pq(
                    torch.where(active, turned, p),
                    torch.where(active, quaternion_multiply(yaw_quaternion(turn), q), q),
                )
            )
