"""The task LiftPegUpright-v1."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import torch
from mani_skill.envs.tasks.tabletop.lift_peg_upright import LiftPegUprightEnv

from symsteer.bench.sim.rotations import quaternion_to_matrix
from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.tasks.experts import (
    CLOSED,
    OPEN,
    Intent,
    choose,
    finger_width,
    grasp_at,
    yaw_along,
)
from symsteer.bench.tasks.features import (
    GRASP_YAW,
    Thing,
    disc,
    flat_pose,
    vector_fields,
    yaw_up_to,
)
from symsteer.policies.geometry import Field


class LiftPegUpright(SymmetricTask, LiftPegUprightEnv):
    """Set a lying peg upright.

    ManiSkill's LiftPegUpright-v1 with rotation-symmetric resets and success, for which the tilt is
    measured from the peg's axis itself (docs/tasks/lift-peg-upright.md). The peg is its own image
    under half turns, so its axis is observed up to its sign, as the three irreps of the symmetric
    traceless tensor of the axis.
    """

    task_id = "LiftPegUpright-v1"
    max_episode_steps = 50
    task_fields = (
        *vector_fields("peg"),
        Field("peg_line", 2),
        Field("peg_lean", 1),
        Field("peg_rise", 0),
        *vector_fields("tcp_to_peg"),
        *GRASP_YAW,
    )
    things: ClassVar[dict[str, Thing]] = {"peg": Thing("peg", turns=2)}
    manipulated_name = "peg"
    spawn_radius = 0.1
    spawn_extent = 0.223
    upright_tolerance = 0.08
    height_tolerance = 0.005
    grip_from_end = 0.02
    """Where the expert grasps, metres from an end."""
    grip_force = 6.0
    """Force of each finger, newtons; fully closed fingers would keep the peg's tilt."""

    def _place_objects(self, rng: Any, count: int) -> None:
        u = rng.uniform(size=3)
        yaw = 2 * np.pi * u[:, 2]
        xy = disc(u[:, :2], self.spawn_radius)
        self.peg.set_pose(flat_pose(xy, self.peg_half_width, yaw, self.device))

    def evaluate(self) -> dict[str, torch.Tensor]:
        """``success [N]``: the peg is upright to 0.08 rad and stands at its height to 5 mm."""
        axis = quaternion_to_matrix(self.peg.pose.q)[:, :, 0]
        tilt = torch.atan2(axis[:, :2].norm(dim=1), axis[:, 2].abs())
        height = (self.peg.pose.p[:, 2] - self.peg_half_length).abs()
        return {"success": (tilt < self.upright_tolerance) & (height < self.height_tolerance)}

    def _observe_task(self) -> dict[str, torch.Tensor]:
        peg = self.seen(self.peg.pose, "object").q
        axis = quaternion_to_matrix(peg)[:, :, 0]
        return {
            **super()._observe_task(),
            "peg_line": yaw_up_to(2, peg),
            "peg_lean": axis[:, 2:] * axis[:, :2],
            "peg_rise": axis[:, 2:] ** 2,
        }

    def intent(self, offset: torch.Tensor) -> Intent:
        """Grasp the peg near an end, raise that end about the other one, let go.

        The grip is loose, so that the peg turns between the fingers and its foot stays on the
        table.
        """
        tcp, peg = self.agent.tcp_pose.p, self.peg.pose
        axis = quaternion_to_matrix(peg.q)[:, :, 0]
        # The end to be raised: the higher one; of a lying peg the nearer one.
        towards = tcp - peg.p
        towards = torch.cat([towards[:, :2], torch.zeros_like(towards[:, 2:])], dim=1)
        score = (axis * towards).sum(dim=1) + axis[:, 2]
        axis = torch.where(score[:, None] < 0, -axis, axis)
        handle = peg.p + (self.peg_half_length - self.grip_from_end) * axis
        yaw = yaw_along(self, axis[:, :2])
        # Half the turn: the fingers come down at twice the usual misalignment, because they turn
        # the peg as they close.
        approach, held = grasp_at(self, handle + offset, handle, yaw / 2, 2 * self.peg_half_width)
        approach = replace(approach, yaw=2 * approach.yaw)
        # Along the circle about the other end, in the vertical plane of the axis.
        rise = axis[:, 2]
        flat = axis[:, :2].norm(dim=1)
        bearing = axis[:, :2] / flat[:, None].clamp_min(1e-6)
        tilt = torch.atan2(flat, rise)
        radius = 2 * self.peg_half_length - self.grip_from_end
        step = (radius * tilt).clamp(0.0, 0.05)
        # Height of the peg's lowest corner, by which a lifted peg goes down again.
        foot = peg.p[:, 2] - self.peg_half_length * rise - self.peg_half_width * flat
        arc = torch.cat([-(step * rise)[:, None] * bearing, (step * flat - foot)[:, None]], dim=1)
        raise_end = Intent.to(arc, self._loose)
        release = Intent.to_let_go(finger_width(self) > 0.06)
        stands = (tilt < 0.06) & (foot.abs() < 0.004)
        return choose(stands, release, choose(held, raise_end, approach))

    @property
    def _loose(self) -> float:
        """Gripper action at which each finger presses the peg with ``grip_force`` newtons."""
        # The finger drives are springs; actions span finger positions of -1 to 4 cm.
        target = self.peg_half_width - self.grip_force / self.agent.gripper_stiffness
        return CLOSED + (OPEN - CLOSED) * (target + 0.01) / 0.05
