"""What carries the gripper: nothing (``floating``) or ManiSkill's stock Panda arm (``panda``).

An embodiment says where the robot stands, how it is placed at a reset, how far its actions move
it, and how its state turns with the world.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from mani_skill.agents.robots import Panda

from symsteer.bench.sim.rotations import (
    euler_rates_matrix,
    euler_to_matrix,
    matrix_to_euler_facing_down,
    planar_matrix,
    transform_angular,
)
from symsteer.bench.tasks.features import disc
from symsteer.bench.tasks.floating import (
    ACTION_LAYOUT,
    TCP_OFFSET,
    FloatingGripper,
    PlanarPoseControllerConfig,
    bound_blocks,
)
from symsteer.errors import UserError


@dataclass(frozen=True)
class Embodiment:
    """Base of the embodiments; one shared instance each in :data:`BODIES`."""

    name: str
    robot_uid: str
    root_position: tuple[float, float, float]
    control_mode: str = "pd_ee_delta_pose"
    noise_scale: float = 1.0
    """Factor on the action noise of demonstrations, relative to the floating gripper."""
    horizontal_step: float = PlanarPoseControllerConfig.horizontal_step
    """How far the tool goes in one control step at action 1, metres."""
    drag_gain: float = 1.0
    """Factor on an expert's displacements while it drags a load over the table."""

    def initial_qpos(self, rng: Any, count: int) -> np.ndarray:
        """Joint positions at a reset, ``[count, dof]``, from one random generator per row."""
        raise NotImplementedError

    def bound(self, action: torch.Tensor) -> torch.Tensor:
        """The part of ``action [N, 7]`` that the controller will execute; idempotent."""
        raise NotImplementedError

    def command(self, move: torch.Tensor, turn: torch.Tensor) -> torch.Tensor:
        """Action ``[N, 6]`` (not bounded) that moves the tool centre point.

        Args:
            move: wanted displacement in the world, ``[N, 3]`` metres.
            turn: wanted rotation vector in the world, ``[N, 3]`` radians.
        """
        raise NotImplementedError

    def set_bias(self, agent: Any, bias: torch.Tensor) -> None:
        """Let the actuator drift: add to every horizontal step, after the controller's bound.

        Args:
            agent: the robot, whose controller is new.
            bias: in units of a full step of each environment, ``[N, 2]``. What is written into
                it later counts from then on.
        """
        raise NotImplementedError

    def reachable_turn(
        self, qpos: torch.Tensor, turn: torch.Tensor, later: torch.Tensor
    ) -> torch.Tensor:
        """Choose a turn that the joints can reach among those that differ by half turns.

        Args:
            qpos: joint positions, ``[N, dof]``.
            turn: the smallest of the equivalent turns about the vertical, ``[N]`` radians.
            later: a further turn that will follow, ``[N]``.
        """
        return turn

    def transform_robot(self, state: torch.Tensor, angle: float, reflect: bool) -> torch.Tensor:
        """Act with (angle, reflect) on an articulation state ``[N, 13 + 2 dof]``.

        Raises:
            UserError: if the robot cannot take the rotated states.
        """
        raise UserError(
            f"states of the {self.name!r} embodiment cannot be rotated exactly: its base is "
            "fixed; use embodiment 'floating'"
        )

    def transform_controller(self, state: dict, angle: float, reflect: bool) -> dict:
        """Act with (angle, reflect) on the controller's state."""
        return state

    def shift_robot(self, state: torch.Tensor, offset: torch.Tensor) -> torch.Tensor:
        """Move the hand of articulation states ``[N, 13 + 2 dof]`` by ``offset [N, 2]`` metres."""
        raise NotImplementedError

    def shift_controller(self, state: dict, offset: torch.Tensor) -> dict:
        """Move the controller's targets by ``offset [N, 2]`` metres."""
        return state


@dataclass(frozen=True)
class Floating(Embodiment):
    """The armless gripper: actions and states turn with the world.

    At a reset the tool centre point is uniform in a disc of 5 cm radius, at heights of 14 to
    20 cm; the tool points straight down and the wrist yaw is uniform on the circle.
    """

    name: str = "floating"
    robot_uid: str = FloatingGripper.uid
    root_position: tuple[float, float, float] = (0.0, 0.0, FloatingGripper.root_height)

    def initial_qpos(self, rng: Any, count: int) -> np.ndarray:
        u = rng.uniform(size=4)
        qpos = np.zeros((count, 8), dtype=np.float32)
        qpos[:, :2] = disc(u[:, :2], 0.05)
        qpos[:, 2] = 0.14 + 0.06 * u[:, 2] + TCP_OFFSET - self.root_position[2]
        qpos[:, 4] = np.pi
        qpos[:, 5] = np.pi * (2 * u[:, 3] - 1)
        qpos[:, 6:] = 0.04
        return qpos

    def bound(self, action: torch.Tensor) -> torch.Tensor:
        return bound_blocks(action, ACTION_LAYOUT)

    def command(self, move: torch.Tensor, turn: torch.Tensor) -> torch.Tensor:
        steps = PlanarPoseControllerConfig
        return torch.cat(
            [
                move[:, :2] / steps.horizontal_step,
                move[:, 2:] / steps.vertical_step,
                turn[:, :2] / steps.tilt_step,
                turn[:, 2:] / steps.yaw_step,
            ],
            dim=1,
        )

    def set_bias(self, agent: Any, bias: torch.Tensor) -> None:
        agent.controller.controllers["root"].bias = bias

    def transform_robot(self, state: torch.Tensor, angle: float, reflect: bool) -> torch.Tensor:
        root, q, v = state[:, :13], state[:, 13:21], state[:, 21:29]
        world = planar_matrix(angle, reflect, state)
        turned = self._transform_root_joints(q[:, :6], angle, reflect)
        spin = (euler_rates_matrix(q[:, 3:6]) @ v[:, 3:6, None]).squeeze(-1)
        rates = torch.linalg.solve(
            euler_rates_matrix(turned[:, 3:]), transform_angular(spin, angle, reflect)
        )
        # A mirror image swaps the fingers.
        fingers = [1, 0] if reflect else [0, 1]
        return torch.cat(
            [root, turned, q[:, 6:][:, fingers], v[:, :3] @ world.T, rates, v[:, 6:][:, fingers]],
            dim=1,
        )

    def transform_controller(self, state: dict, angle: float, reflect: bool) -> dict:
        turned = self._transform_root_joints(state["root"]["target_qpos"], angle, reflect)
        return {**state, "root": {"target_qpos": turned}}

    def shift_robot(self, state: torch.Tensor, offset: torch.Tensor) -> torch.Tensor:
        moved = state.clone()
        moved[:, 13:15] += offset
        return moved

    def shift_controller(self, state: dict, offset: torch.Tensor) -> dict:
        target = state["root"]["target_qpos"].clone()
        target[:, :2] += offset
        return {**state, "root": {"target_qpos": target}}

    @staticmethod
    def _transform_root_joints(q: torch.Tensor, angle: float, reflect: bool) -> torch.Tensor:
        world = planar_matrix(angle, reflect, q)
        rotation = world @ euler_to_matrix(q[:, 3:])
        if reflect:
            rotation = rotation * rotation.new_tensor([1.0, -1.0, 1.0])
        near = q[:, 3:].clone()
        # The tool points down, so yaw (seen from above) and the last joint turn in opposite senses.
        near[:, 2] = (-near[:, 2] if reflect else near[:, 2]) - angle
        return torch.cat([q[:, :3] @ world.T, matrix_to_euler_facing_down(rotation, near)], dim=1)


@dataclass(frozen=True)
class PandaArm(Embodiment):
    """ManiSkill's stock Panda and stock ``pd_ee_delta_pose``: kinematics break the symmetry.

    At a reset the arm is in ManiSkill's rest pose with its joint noise of 0.02 rad; the wrist
    yaw is uniform over 240 degrees, what joint 7 allows while keeping 45 degrees for a grasp.
    """

    name: str = "panda"
    robot_uid: str = Panda.uid
    root_position: tuple[float, float, float] = (-0.615, 0.0, 0.0)
    # Stock action 1 asks for 0.1 m or 0.1 rad, of which one control step of the non-target
    # controller covers about 40 %.
    step: float = 0.1
    horizontal_step: float = 0.04
    gain: float = 2.0
    noise_scale: float = 0.6
    # Of joint 7, whose stops are at 2.897 rad.
    wrist_limit: float = 2.87
    drag_gain: float = 1.8

    def initial_qpos(self, rng: Any, count: int) -> np.ndarray:
        qpos = np.tile(np.asarray(Panda.keyframes["rest"].qpos, dtype=np.float64), (count, 1))
        qpos += rng.normal(0.0, 0.02, 9)
        qpos[:, 6] = rng.uniform(-1.0, 1.0, 1)[:, 0] * math.radians(120)
        qpos[:, 7:] = 0.04
        return qpos.astype(np.float32)

    def bound(self, action: torch.Tensor) -> torch.Tensor:
        position = action[:, :3].clamp(-1, 1)
        rotation = action[:, 3:6]
        norm = rotation.norm(dim=1, keepdim=True)
        rotation = torch.where(norm > 1 + 1e-6, rotation / norm.clamp_min(1e-12), rotation)
        return torch.cat([position, rotation, action[:, 6:].clamp(-1, 1)], dim=1)

    def command(self, move: torch.Tensor, turn: torch.Tensor) -> torch.Tensor:
        # ManiSkill multiplies the rotation by rot_lower = -0.1: a positive action turns the
        # other way.
        scale = self.gain / self.step
        move = scale * move
        move = move / move.abs().amax(dim=1, keepdim=True).clamp_min(1.0)
        return torch.cat([move, -scale * turn], dim=1)

    def set_bias(self, agent: Any, bias: torch.Tensor) -> None:
        # The stock controller bounds its action, so the drift is added after that.
        arm = agent.controller.controllers["arm"]
        scale = arm._clip_and_scale_action
        xy = ACTION_LAYOUT.slice("xy")

        def scale_and_drift(action: torch.Tensor) -> torch.Tensor:
            step, drift = scale(action), self.step * bias
            drifted = step.clone()
            drifted[:, xy] += drift
            return torch.where((drift != 0).any(dim=1, keepdim=True), drifted, step)

        arm._clip_and_scale_action = scale_and_drift

    def reachable_turn(
        self, qpos: torch.Tensor, turn: torch.Tensor, later: torch.Tensor
    ) -> torch.Tensor:
        """The smallest turn that keeps joint 7 within its limits.

        A grasp may end 0.2 rad short of its turn: closing fingers align the object.
        """
        turns = turn[:, None] + math.pi * turn.new_tensor([0.0, -1.0, 1.0])
        # The joint turns against the tool's yaw (seen from above).
        there = qpos[:, 6:7] - turns
        excess = (there.abs() - self.wrist_limit - 0.2).maximum(
            (there - later[:, None]).abs() - self.wrist_limit
        )
        excess = excess.clamp_min(0.0)
        best = (turns.abs() + 100.0 * excess).argmin(dim=1, keepdim=True)
        return turns.gather(1, best)[:, 0]


BODIES: dict[str, Embodiment] = {e.name: e for e in (Floating(), PandaArm())}
"""All embodiments by name."""
