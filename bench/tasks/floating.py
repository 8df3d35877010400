"""A gripper without an arm, whose control commutes with rotations about the vertical axis.

The body is ManiSkill's ``floating_panda_gripper``: three prismatic and three revolute joints
carry the Panda hand. ManiSkill's own ``pd_ee_delta_pose`` for it goes through inverse kinematics
and bounds each axis separately. Here the control mode of that name moves a target pose of the tool
centre point, bounds each geometric block by its norm, and converts the target to joint angles in
closed form, so that rotating state and action rotates the target exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from gymnasium import spaces
from mani_skill.agents.controllers import (
    PDJointPosControllerConfig,
    PDJointPosMimicControllerConfig,
)
from mani_skill.agents.controllers.pd_joint_pos import PDJointPosController
from mani_skill.agents.registration import register_agent
from mani_skill.agents.robots import FloatingPandaGripper
from torch.linalg import vector_norm

from symsteer.bench.sim.contacts import is_grasping
from symsteer.bench.sim.rotations import (
    euler_to_matrix,
    matrix_to_euler_facing_down,
    rotation_vector_to_matrix,
)
from symsteer.policies.geometry import Field, Layout

ACTION_LAYOUT = Layout(
    [
        Field("xy", 1),
        Field("z", 0),
        Field("tilt", 1, odd=True),
        Field("yaw", 0, odd=True),
        Field("gripper", 0),
    ]
)
"""ManiSkill's order of ``pd_ee_delta_pose``: position, rotation about x, y, z, gripper."""

TCP_OFFSET = 0.1034
"""Distance of the tool centre point from the hand's origin along the tool axis (URDF), metres."""


def bound_blocks(action: torch.Tensor, layout: Layout) -> torch.Tensor:
    """Shorten each irrep block of ``action [..., dim]`` that is longer than 1 to length 1.

    The rule depends on norms only, so it commutes with rotations and reflections. Applying it
    twice gives the same bits as applying it once.
    """
    blocks = [action[..., block] for block in layout.blocks]
    norms = [vector_norm(block, dim=-1, keepdim=True).expand_as(block) for block in blocks]
    norm = torch.cat(norms, dim=-1)
    # The margin keeps a block that was scaled to length 1 (up to rounding) from being scaled again.
    return torch.where(norm > 1 + 1e-6, action / norm.clamp_min(1e-12), action)


class PlanarPoseController(PDJointPosController):
    """Moves a target pose of the tool centre point by increments in the world frame.

    The target, kept as the six root joint positions, is the controller's state: it is saved with
    and restored from the simulation state.
    """

    config: PlanarPoseControllerConfig
    _target_qpos: torch.Tensor
    bias: torch.Tensor | None = None
    """Drift of the actuator, added to every bounded horizontal increment, ``[N, 2]`` full steps."""

    def _initialize_action_space(self) -> None:
        self.single_action_space = spaces.Box(-1.0, 1.0, (6,), np.float32)

    def set_action(self, action: torch.Tensor) -> None:
        """Take one increment ``action [N, 6]`` (xy, z, tilt, yaw) and drive the joints to it."""
        config = self.config
        gripper = torch.zeros_like(self._preprocess_action(action)[:, :1])
        action = bound_blocks(torch.cat([action, gripper], dim=1), ACTION_LAYOUT)
        xy, z, tilt, yaw = (action[:, ACTION_LAYOUT.slice(n)] for n in ("xy", "z", "tilt", "yaw"))

        actual = self.qpos
        joints = torch.stack([self._target_qpos, actual])
        rotation = euler_to_matrix(joints[:, :, 3:])
        position, tcp = joints[:, :, :3] + TCP_OFFSET * rotation[:, :, :, 2]
        # The target of a blocked gripper must not run away: it stays within max_lag of the body.
        lag = position - tcp
        position = tcp + torch.cat(
            [
                _shorten(lag[:, :2], config.max_lag),
                lag[:, 2:].clamp(-config.max_lag, config.max_lag),
            ],
            dim=1,
        )
        low, high = (height - config.root_height for height in config.height_range)
        step = config.horizontal_step * xy
        if self.bias is not None:
            step = step + config.horizontal_step * self.bias
        position = torch.cat(
            [
                _shorten(position[:, :2] + step, config.reach),
                (position[:, 2:] + config.vertical_step * z).clamp(low, high),
            ],
            dim=1,
        )
        turn = torch.cat([config.tilt_step * tilt, config.yaw_step * yaw], dim=1)
        rotation = _limit_tilt(rotation_vector_to_matrix(turn) @ rotation[0], config.max_tilt)

        self._step = 0
        self._start_qpos = actual
        self._target_qpos = torch.cat(
            [
                position - TCP_OFFSET * rotation[:, :, 2],
                matrix_to_euler_facing_down(rotation, self._target_qpos[:, 3:]),
            ],
            dim=1,
        )
        self.set_drive_targets(self._target_qpos)

    def get_state(self) -> dict:
        """The target as joint positions, ``[N, 6]``; a copy."""
        return {"target_qpos": self._target_qpos.clone()}

    def set_state(self, state: dict) -> None:
        """Restore the target; an absent state leaves it at the present pose."""
        if state:
            target = torch.as_tensor(state["target_qpos"], device=self.device)
            self._target_qpos = target.reshape(-1, 6).to(self.qpos.dtype).clone()
        else:
            self._target_qpos = self.qpos.clone()


def _shorten(vector: torch.Tensor, length: float) -> torch.Tensor:
    """Scale ``vector [N, 2]`` down to ``length`` where it is longer."""
    norm = vector_norm(vector, dim=1, keepdim=True)
    return vector * (length / norm.clamp_min(length))


def _limit_tilt(rotation: torch.Tensor, limit: float) -> torch.Tensor:
    """Turn the tool axis back towards straight down where it leans by more than ``limit``."""
    axis = rotation[:, :, 2]
    horizontal = vector_norm(axis[:, :2], dim=1)
    excess = (torch.atan2(horizontal, -axis[:, 2]) - limit).clamp_min(0.0)
    if not excess.any():
        return rotation
    # The horizontal direction about which the axis falls back: axis x down, normalised.
    back = torch.stack([-axis[:, 1], axis[:, 0], torch.zeros_like(horizontal)], dim=1)
    back = back / horizontal.clamp_min(1e-9)[:, None]
    return rotation_vector_to_matrix(excess[:, None] * back) @ rotation


@dataclass
class PlanarPoseControllerConfig(PDJointPosControllerConfig):
    """Step sizes at action 1 and limits of :class:`PlanarPoseController` (metres, radians)."""

    use_target: bool = True
    normalize_action: bool = False
    horizontal_step: float = 0.03
    vertical_step: float = 0.03
    tilt_step: float = 0.1
    yaw_step: float = 0.2
    max_lag: float = 0.02
    max_tilt: float = 0.6
    reach: float = 0.4
    height_range: tuple[float, float] = (0.012, 0.5)
    root_height: float = 0.0
    controller_cls = PlanarPoseController


@register_agent()
class FloatingGripper(FloatingPandaGripper):
    """ManiSkill's floating Panda gripper with what table-top tasks need of a robot.

    Adds to its parent: ``tcp_pose``, ``tcp_pos``, ``is_grasping`` (the Panda's test), ``is_static``
    and the rotation-equivariant control mode ``pd_ee_delta_pose``.
    """

    uid = "symsteer_floating_gripper"
    # Only the fingers could touch each other. Their joints' limits stop closed ones all the same,
    # and their contact is half of the physics of a task with a closed gripper.
    disable_self_collisions = True
    root_height = 0.3
    # About critically damped for the hand's 0.76 kg: a target is reached to 90 % within one
    # control step of 50 ms.
    root_stiffness = 4e3
    root_damping = 1.2e2
    root_force_limit = 300.0

    @property
    def _controller_configs(self) -> dict:
        inherited = super()._controller_configs
        root = PlanarPoseControllerConfig(
            self.root_joint_names,
            lower=None,
            upper=None,
            stiffness=self.root_stiffness,
            damping=self.root_damping,
            force_limit=self.root_force_limit,
            root_height=self.root_height,
        )
        gripper = PDJointPosMimicControllerConfig(
            self.gripper_joint_names,
            lower=-0.01,  # a thin object is still pressed
            upper=0.04,
            stiffness=self.gripper_stiffness,
            damping=self.gripper_damping,
            force_limit=self.gripper_force_limit,
            mimic={"panda_finger_joint2": {"joint": "panda_finger_joint1"}},
        )
        # ManiSkill leaves out which finger follows, and warns each time that it has to assume it.
        first, second = self.gripper_joint_names
        mimic = {first: {"joint": second}}
        joints = {
            mode: {**inherited[mode], "gripper": replace(inherited[mode]["gripper"], mimic=mimic)}
            for mode in ("pd_joint_delta_pos", "pd_joint_pos")
        }
        return {"pd_ee_delta_pose": {"root": root, "gripper": gripper}, **joints}

    is_grasping = is_grasping

    @property
    def tcp_pose(self):
        """Pose of the tool centre point in the world."""
        return self.tcp.pose

    @property
    def tcp_pos(self) -> torch.Tensor:
        """Position of the tool centre point, ``[N, 3]``."""
        return self.tcp.pose.p

    def is_static(self, threshold: float = 0.2) -> torch.Tensor:
        """Whether the hand is slow, ``[N]`` bool.

        The Panda compares each joint's speed with ``threshold``; here horizontal speed, vertical
        speed, tilt rate and yaw rate are compared, so that the direction of motion does not matter.
        """
        v = self.robot.get_qvel()[..., :6]
        speeds = torch.stack(
            [v[:, :2].norm(dim=1), v[:, 2].abs(), v[:, 3:5].norm(dim=1), v[:, 5].abs()], dim=1
        )
        return (speeds <= threshold).all(dim=1)
