"""The camera that sees the objects is mounted at an angle."""

from __future__ import annotations

import math

import torch
from mani_skill.utils.structs import Pose

from symsteer.bench.sim.rotations import quaternion_multiply
from symsteer.bench.variants.base import Role, Variant


class CameraRotation(Variant):
    """Objects are reported turned by 10 degrees * strength about the centre; tool and goal exact.

    As with a camera over the workspace that is mounted at an angle. In maps of heights, clouds and
    pictures from the hand, all bodies are seen turned. Vectors between tool and objects are wrong,
    so that a frozen policy misses. But rotations of the plane commute with each other: every C_n
    remains a symmetry, and an audit must find no defect under C_n beyond that of a picture's
    pixels. Reflections do not commute with it.
    Breaks the observation, everywhere; rotations survive, reflections do not.
    """

    def perceive(self, pose: Pose, role: Role) -> Pose:
        if role != "object":
            return pose
        angle = math.radians(10) * self.amount
        c, s, zero = angle.cos(), angle.sin(), torch.zeros_like(angle)
        matrix = torch.stack([c, -s, s, c], dim=1).view(-1, 2, 2)
        centre = pose.p.new_tensor(self.env.workspace_center)
        p = pose.p.clone()
        p[:, :2] = ((matrix @ (p[:, :2] - centre)[:, :, None]).squeeze(2)) + centre
        half = torch.stack([(angle / 2).cos(), zero, zero, (angle / 2).sin()], dim=1)
        return type(pose).create_from_pq(
            self.only_active(p, pose.p),
            self.only_active(quaternion_multiply(half, pose.q), pose.q),
        )
