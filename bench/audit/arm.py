"""Turned states of an arm with a fixed base, by inverse kinematics.

The tool's pose is turned, and joint angles that reach it are searched. The base cannot turn, so
the elbow is not where the turned elbow would be: this breaks the symmetry, and the audit measures
it. Some turned poses have no solution.
"""

from __future__ import annotations

import contextlib
import io
import math
from pathlib import Path

import pytorch_kinematics as pk
import torch
from mani_skill.agents.robots import Panda

from symsteer.bench.sim.kinematics import SerialChain
from symsteer.bench.sim.rotations import planar_matrix, transform_angular, wrap
from symsteer.bench.tasks.base import SymmetricTask

ITERATIONS = 60
DAMPING = 0.02
LARGEST_STEP = 0.3
"""Largest step of a joint in one iteration, radians."""
POSITION_TOLERANCE, ANGLE_TOLERANCE = 1e-5, 1e-4
"""Tolerances of a reached pose, metres and radians."""
SPREAD = 0.35
"""Standard deviation of the random starts around the other two, radians."""
RANDOM_STARTS = 4


class ArmTurner:
    """Finds joint states of a Panda that turn its tool.

    Damped least squares from several starts: the state's own joints and ManiSkill's rest pose,
    both with base joint and wrist set to the turned bearing and yaw, and random ones around them.
    Among solutions within the joint limits, the one whose first six joints are closest to the
    original is chosen, so that the arm changes as little as possible.

    Args:
        env: a task with the ``panda`` embodiment.
    """

    def __init__(self, env: SymmetricTask) -> None:
        urdf = Path(env.agent.urdf_path).read_bytes()
        # The parser prints a line for each attribute of the URDF that it does not know.
        with contextlib.redirect_stderr(io.StringIO()), contextlib.redirect_stdout(io.StringIO()):
            chain = pk.build_serial_chain_from_urdf(urdf, end_link_name=env.agent.tcp.name)
            self.chain = chain.to(dtype=torch.float64)
            exact = pk.build_serial_chain_from_urdf(urdf, end_link_name=env.agent.tcp.name)
        self.fast = SerialChain(exact)
        low, high = self.chain.get_joint_limits()
        self.low = torch.tensor(low, dtype=torch.float64)
        self.high = torch.tensor(high, dtype=torch.float64)
        self.joints = len(low)
        self.base = torch.tensor(env.body.root_position, dtype=torch.float64)
        self.rest = torch.tensor(Panda.keyframes["rest"].qpos[: self.joints], dtype=torch.float64)

    def turn(
        self, state: torch.Tensor, angle: float, reflect: bool, offset: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Turn articulation states about the world's origin, then shift them.

        The tool's velocity is turned too; the joint velocities are the smallest that give it.
        Finger joints are copied (a reflection swaps them).

        Args:
            state: articulation states, ``[S, 13 + 2 dof]``.
            angle: rotation, radians.
            reflect: whether the reflection of y comes first.
            offset: shift, ``[S, 2]`` metres.

        Returns:
            The states, and which of them are reachable, ``[S]`` bool; unreachable rows are the
            original ones.
        """
        n, dof = self.joints, (state.shape[1] - 13) // 2
        joints, rates = state[:, 13 : 13 + dof].double(), state[:, 13 + dof :].double()
        q, v = joints[:, :n], rates[:, :n]
        position, rotation = self._tool(q)
        world = planar_matrix(angle, reflect, position)
        target = (position + self.base) @ world.T - self.base
        target[:, :2] += offset
        frame = world @ rotation
        if reflect:
            frame = frame * frame.new_tensor([1.0, -1.0, 1.0])
        starts = self._starts(target, q, angle, reflect)
        solution, reached = self._solve(target, frame, q, starts)

        twist = (self._jacobian(q) @ v[:, :, None])[:, :, 0]
        wanted = torch.cat(
            [twist[:, :3] @ world.T, transform_angular(twist[:, 3:], angle, reflect)], dim=1
        )
        speed = torch.linalg.pinv(self._jacobian(solution), rtol=1e-3) @ wanted[:, :, None]
        fingers = [n + 1, n] if reflect else [n, n + 1]
        new = [solution, joints[:, fingers], speed[:, :, 0], rates[:, fingers]]
        turned = torch.cat([state[:, :13].double(), *new], dim=1).to(state.dtype)
        return torch.where(reached[:, None], turned, state), reached

    def _solve(
        self, target: torch.Tensor, frame: torch.Tensor, near: torch.Tensor, start: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Joint angles ``[S, 7]`` that reach tool poses in the base's frame, and whether they do.

        Args:
            target, frame: positions ``[S, 3]`` and orientations ``[S, 3, 3]``.
            near: the joint angles before the turn ``[S, 7]``.
            start: where the search begins, ``[starts, S, 7]``.
        """
        count = len(start)
        q = start.reshape(-1, self.joints)
        goal, pose = target.repeat(count, 1), frame.repeat(count, 1, 1)
        for _ in range(ITERATIONS):
            error = self._error(q, goal, pose)
            far = self._missed(error)
            if not far.any():
                break
            q[far] = self._improve(q[far], error[far])
        miss = self._missed(self._error(q, goal, pose)).view(count, -1)
        q = q.view(count, -1, self.joints)
        change = (q - near)[:, :, : self.joints - 1].norm(dim=-1)
        best = torch.where(miss, torch.inf, change).argmin(dim=0)
        rows = torch.arange(len(near))
        return q[best, rows], ~miss[best, rows]

    def _starts(
        self, target: torch.Tensor, near: torch.Tensor, angle: float, reflect: bool
    ) -> torch.Tensor:
        """Initial joint angles, ``[starts, S, 7]``."""
        bearing = torch.atan2(target[:, 1], target[:, 0])
        before, _ = self._tool(near)
        swing = bearing - torch.atan2(before[:, 1], before[:, 0])
        generator = torch.Generator().manual_seed(0)
        chosen = []
        for origin in (near, self.rest.expand_as(near)):
            guess = origin.clone()
            if reflect:
                # The mirror image of the arm: joints that turn out of its plane change sign.
                guess[:, ::2] *= -1
            base = bearing if origin is not near else guess[:, 0] + swing
            # The last joint turns against the tool's yaw; with base joint and wrist at 0 the yaw
            # of the fingers is an eighth of a turn.
            yaw = near[:, 0] - near[:, 6] + math.pi / 4
            yaw = (-yaw if reflect else yaw) + angle
            guess[:, 0], guess[:, 6] = base, wrap(base + math.pi / 4 - yaw, 2 * math.pi)
            chosen.append(guess)
        for i in range(RANDOM_STARTS):
            noise = SPREAD * torch.randn(near.shape, generator=generator, dtype=near.dtype)
            chosen.append(chosen[i % 2] + noise)
        return torch.stack(chosen).clamp(self.low, self.high)

    def _improve(self, q: torch.Tensor, error: torch.Tensor) -> torch.Tensor:
        jacobian = self._jacobian(q)
        # Damping decreases with the error, so the last iterations are Newton steps.
        damping = DAMPING * error.norm(dim=1).clamp(max=1.0)
        square = jacobian @ jacobian.transpose(1, 2)
        square = square + (damping**2 + 1e-12)[:, None, None] * torch.eye(6, dtype=q.dtype)
        step = jacobian.transpose(1, 2) @ torch.linalg.solve(square, error[:, :, None])
        step = step[:, :, 0]
        longest = step.abs().amax(dim=1, keepdim=True)
        step = step * (LARGEST_STEP / longest.clamp_min(LARGEST_STEP))
        return (q + step).clamp(self.low, self.high)

    def _error(self, q: torch.Tensor, goal: torch.Tensor, pose: torch.Tensor) -> torch.Tensor:
        """Position and rotation vector from the tool to its goal, ``[B, 6]``."""
        position, rotation = self._tool(q)
        turn = pose @ rotation.transpose(1, 2)
        return torch.cat([goal - position, _rotation_vector(turn)], dim=1)

    @staticmethod
    def _missed(error: torch.Tensor) -> torch.Tensor:
        place, angle = error[:, :3].norm(dim=1), error[:, 3:].norm(dim=1)
        return (place > POSITION_TOLERANCE) | (angle > ANGLE_TOLERANCE)

    def _tool(self, q: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Position ``[B, 3]`` and orientation ``[B, 3, 3]`` of the tool in the base's frame."""
        matrix = self.chain.forward_kinematics(q).get_matrix()
        return matrix[:, :3, 3], matrix[:, :3, :3]

    def _jacobian(self, q: torch.Tensor) -> torch.Tensor:
        # Single precision is enough for the step; the error is computed in double precision.
        return self.fast.jacobian(q.float()).double()


def _rotation_vector(matrix: torch.Tensor) -> torch.Tensor:
    """Rotation vectors ``[B, 3]`` of matrices ``[B, 3, 3]``."""
    axis = torch.stack(
        [
            matrix[:, 2, 1] - matrix[:, 1, 2],
            matrix[:, 0, 2] - matrix[:, 2, 0],
            matrix[:, 1, 0] - matrix[:, 0, 1],
        ],
        dim=1,
    )
    sine = axis.norm(dim=1) / 2
    cosine = (matrix.diagonal(dim1=1, dim2=2).sum(dim=1) - 1) / 2
    angle = torch.atan2(sine, cosine)
    # At half a turn the antisymmetric part is zero, and any small step leads away from it.
    return axis / (2 * sine).clamp_min(1e-12)[:, None] * angle[:, None]
