"""The task PushT-v1."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import numpy as np
import torch
from mani_skill.envs.tasks.tabletop.push_t import PushTEnv
from mani_skill.utils.structs import Pose

from symsteer.bench.sim.rotations import quaternion_to_matrix
from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.tasks.experts import CLOSED, Intent, choose, grasp_at, yaw_along
from symsteer.bench.tasks.features import (
    GRASP_YAW,
    Thing,
    disc,
    flat_pose,
    goal_disc_pose,
    vector_fields,
)
from symsteer.policies.geometry import Field, Layout

HORIZONTAL = Layout([Field("xy", 1)])


class PushT(SymmetricTask, PushTEnv):
    """Bring a T-shaped block onto a T drawn on the table.

    ManiSkill's PushT-v1 with a goal anywhere, which is the pose of its goal actor, and any gripper.
    Success and dense reward are made symmetric (docs/tasks/push-t.md): the yaw comes from an arc
    tangent, and the overlap is the mean of two, of block and goal and of their mirror images,
    because ManiSkill's drawing is one pixel (4.7 mm) off. Stock's marker lies under the goal.
    """

    task_id = "PushT-v1"
    max_episode_steps = 100
    mirrored_across_yz = frozenset({"Tee", "goal_Tee"})
    task_fields = (
        *vector_fields("tee"),
        Field("tee_stem", 1),
        *vector_fields("tcp_to_tee"),
        *GRASP_YAW,
        Field("goal_xy", 1),
        Field("goal_stem", 1),
        Field("tee_to_goal_xy", 1),
        Field("turn_cos", 0),
        Field("turn_sin", 0, odd=True),
    )
    things: ClassVar[dict[str, Thing]] = {
        "tee": Thing("tee", turns=2),
        "goal": Thing("goal_tee", "goal"),
    }
    manipulated_name = "tee"
    spawn_radius = 0.1
    goal_spawn_radius = 0.05
    spawn_extent = 0.24
    half_thickness = 0.02
    solver_iterations = 60
    """Of PhysX, for the block's contacts: with ManiSkill's 15 the drag of its friction depends on
    its direction, and that of one step of the tool by 2.3 % instead of 1.5 %."""
    lowest_grip = 0.014
    """Least height of the tool while it drags, metres."""
    max_turn = math.pi / 2
    """Largest difference of yaw between block and goal at a reset, radians."""
    grip_on_stem = 0.04
    """Where the expert grasps: metres along the stem from the centre of mass."""
    drawing_offset = -0.0047
    """Metres along the goal's stem at which ManiSkill's drawing puts a block that fits best."""

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        for body in self.tee._bodies:
            body.set_solver_position_iterations(self.solver_iterations)

    def _place_objects(self, rng: Any, count: int) -> None:
        u = rng.uniform(size=6)
        xy, yaw = disc(u[:, :2], self.spawn_radius), 2 * np.pi * u[:, 2]
        self.tee.set_pose(flat_pose(xy, self.half_thickness, yaw, self.device))
        xy, yaw = disc(u[:, 3:5], self.goal_spawn_radius), yaw + self.max_turn * (2 * u[:, 5] - 1)
        self.goal_tee.set_pose(flat_pose(xy, 1e-3, yaw, self.device))
        self.ee_goal_pos.set_pose(goal_disc_pose(xy, yaw, self.device))

    # ------------------------------------------------------------ success, reward

    def quat_to_z_euler(self, quats: torch.Tensor) -> torch.Tensor:
        """Yaw ``[N]`` in [0, 2 pi) of quaternions ``[N, 4]``."""
        return torch.remainder(2 * torch.atan2(quats[:, 3], quats[:, 0]), 2 * torch.pi)

    def pseudo_render_intersection(self) -> torch.Tensor:
        """Share ``[N]`` of the goal that the block covers, in ManiSkill's drawing."""
        tee, goal = self._planar(self.tee.pose), self._planar(self.goal_tee.pose)
        from_world = torch.linalg.inv(tee)
        relative = torch.linalg.inv(goal) @ tee
        mirror = torch.diag(relative.new_tensor([-1.0, 1.0, 1.0]))
        shares = []
        for placed in (relative, mirror @ relative @ mirror):
            # Stock multiplies this by the block's own pose, which leaves ``placed``.
            self.world_to_goal_trans = placed @ from_world
            shares.append(super().pseudo_render_intersection())
        return (shares[0] + shares[1]) / 2

    def _planar(self, pose: Pose) -> torch.Tensor:
        """Homogeneous planar transforms ``[N, 3, 3]`` from body to world."""
        transform = self.quat_to_zrot(pose.q)
        transform[:, :2, 2] = pose.p[:, :2]
        return transform

    def compute_dense_reward(self, obs: Any, action: torch.Tensor, info: dict) -> torch.Tensor:
        """ManiSkill's, with the goal's yaw read from its actor."""
        self.goal_z_rot = self.quat_to_z_euler(self.goal_tee.pose.q)
        try:
            return super().compute_dense_reward(obs, action, info)
        finally:
            del self.goal_z_rot  # the class's number, which building the scene needs

    # ---------------------------------------------------------------- observation

    def _observe_task(self) -> dict[str, torch.Tensor]:
        stem = _stem(self.seen(self.tee.pose, "object").q)
        goal_stem = _stem(self.seen(self.goal_tee.pose, "goal").q)
        return {
            **super()._observe_task(),
            "tee_stem": stem,
            "goal_stem": goal_stem,
            "turn_cos": (stem * goal_stem).sum(dim=1, keepdim=True),
            "turn_sin": _cross(stem, goal_stem)[:, None],
        }

    # --------------------------------------------------------------------- expert

    def intent(self, offset: torch.Tensor) -> Intent:
        """Grasp the stem close to the centre of mass, drag and turn the block onto the goal."""
        tcp, tee, goal = self.agent.tcp_pose.p, self.tee.pose, self.goal_tee.pose
        stem, goal_stem = _stem(tee.q), _stem(goal.q)
        handle = tee.p.clone()
        handle[:, :2] += self.grip_on_stem * stem
        turn = torch.atan2(_cross(stem, goal_stem), (stem * goal_stem).sum(dim=1))
        yaw = yaw_along(self, stem, later=turn)
        # Fingers that grip the 5 cm of the stem slightly askew stop a little further apart.
        approach, held = grasp_at(self, handle + offset, handle, yaw, 0.053)
        # The tool keeps its place in the frame of the block, which becomes that of the goal.
        arm = (tcp - tee.p)[:, :2]
        turned = HORIZONTAL.rotate(arm, turn)
        fit = goal.p[:, :2] + self.drawing_offset * goal_stem
        # Keep the block on the table, and the finger tips, 9 mm below the tool, above it.
        height = self.half_thickness - tee.p[:, 2:] + (self.lowest_grip - tcp[:, 2:]).clamp_min(0.0)
        move = torch.cat([self.body.drag_gain * (fit + turned - tcp[:, :2]), height], dim=1)
        return choose(held, Intent.to(move, CLOSED, turn), approach)


def _stem(q: torch.Tensor) -> torch.Tensor:
    """Horizontal direction ``[N, 2]`` of a T's stem, its body y axis."""
    return quaternion_to_matrix(q)[:, :2, 1]


def _cross(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Vertical component ``[N]`` of the cross product of horizontal vectors ``[N, 2]``."""
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
