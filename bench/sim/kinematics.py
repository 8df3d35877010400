"""Jacobians of serial chains, batched.

ManiSkill's batched inverse kinematics spends most of its time in pytorch_kinematics, which
builds hundreds of small tensors for one Jacobian. This module computes the same matrix in about
thirty tensor operations.
"""

from __future__ import annotations

from typing import Any

import torch


class SerialChain:
    """A chain of revolute joints, built from a pytorch_kinematics chain.

    It has the two methods of that chain which ManiSkill's solver calls.

    Args:
        chain: a ``pytorch_kinematics.SerialChain``.
    """

    def __init__(self, chain: Any) -> None:
        self.chain = chain
        offset = torch.eye(4, dtype=torch.float64)
        offsets, axes = [], []
        for frame in chain._serial_frames:
            if frame.joint.offset is not None:
                offset = offset @ frame.joint.offset.get_matrix()[0].double()
            if frame.joint.joint_type == "fixed":
                continue
            assert frame.joint.joint_type == "revolute", frame.joint
            offsets.append(offset)
            axes.append(frame.joint.axis.double())
            offset = torch.eye(4, dtype=torch.float64)
        stacked = torch.stack(offsets)
        self._rotation = stacked[:, :3, :3].float()
        self._translation = stacked[:, :3, 3:].float()
        self._tool = offset[:3, 3:].float()
        self._axis = torch.stack(axes).float()[..., None]
        self._cross = torch.zeros(len(axes), 3, 3)
        for matrix, (x, y, z) in zip(self._cross, self._axis[..., 0].tolist(), strict=True):
            matrix[:] = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        self._cross_squared = self._cross @ self._cross

    def forward_kinematics(self, q: torch.Tensor) -> Any:
        """Pose of the end link, from the original chain."""
        return self.chain.forward_kinematics(q)

    def jacobian(self, q: torch.Tensor) -> torch.Tensor:
        """Geometric Jacobian of the end link in the base frame.

        Args:
            q: joint positions [B, J], radians.

        Returns:
            ``[B, 6, J]``: per joint velocity, three rows of linear and three of angular velocity.
        """
        angle = q[:, :, None, None]
        # Rodrigues: R(q) = 1 + sin(q) K + (1 - cos(q)) K^2.
        turn = torch.sin(angle) * self._cross + (1 - torch.cos(angle)) * self._cross_squared
        steps = self._rotation + self._rotation @ turn
        rotation = steps[:, 0]
        position = self._translation[0].expand(len(q), 3, 1)
        rotations, positions = [rotation], [position]
        for j in range(1, q.shape[1]):
            position = position + _turned(rotation, self._translation[j])
            rotation = rotation @ steps[:, j]
            rotations.append(rotation)
            positions.append(position)
        end = position + _turned(rotation, self._tool)
        axis = (torch.stack(rotations, 1) @ self._axis)[..., 0]
        arm = (end[:, None] - torch.stack(positions, 1))[..., 0]
        linear = torch.cross(axis, arm, dim=-1)
        return torch.cat([linear, axis], dim=-1).transpose(1, 2)


def _turned(rotation: torch.Tensor, vector: torch.Tensor) -> torch.Tensor:
    """``rotation [B, 3, 3]`` times ``vector [3, 1]``, as one small product per row.

    torch multiplies all rows at once with a single vector, and on some processors the last bits
    of that product depend on the number of rows.
    """
    return rotation @ vector.expand(len(rotation), 3, 1)
