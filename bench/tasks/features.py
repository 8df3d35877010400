"""What tasks share: where things are placed, the fields of observations and their values."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from mani_skill.utils.structs import Pose

from symsteer.bench.sim.rotations import quaternion_multiply, quaternion_to_matrix
from symsteer.policies.geometry import Field

GRASP_YAW = (Field("grasp_yaw_cos", 0), Field("grasp_yaw_sin", 0, odd=True))
"""Of :func:`grasp_yaw` and :func:`bar_grasp_yaw`."""


def vector_fields(*names: str) -> tuple[Field, ...]:
    """Fields of vectors in space: a horizontal and a vertical part of each."""
    return tuple(f for name in names for f in (Field(f"{name}_xy", 1), Field(f"{name}_z", 0)))


def in_parts(**vectors: torch.Tensor) -> dict[str, torch.Tensor]:
    """Vectors ``[N, 3]`` as the parts that :func:`vector_fields` names."""
    fields: dict[str, torch.Tensor] = {}
    for name, vector in vectors.items():
        fields |= {f"{name}_xy": vector[:, :2], f"{name}_z": vector[:, 2:]}
    return fields


def is_direction(name: str) -> bool:
    """Whether a field of this name has parts of a unit vector, such as an axis of the tool."""
    return name.removesuffix("_xy").removesuffix("_z").endswith(("normal", "_axis"))


def fourfold_yaw(q: torch.Tensor) -> torch.Tensor:
    """Yaw of a cube up to its symmetry, ``[N, 2]``: a frequency-4 vector.

    Half the sum over the body's axes of (x + i y)^4 of their horizontal parts: (cos 4 yaw,
    sin 4 yaw) for a cube that lies flat, and the same for all 24 ways to name a cube's axes.
    """
    axes = quaternion_to_matrix(q)[:, :2]
    return _fourth_power(axes[:, 0], axes[:, 1]).sum(dim=1) / 2


def twofold_yaw(q: torch.Tensor) -> torch.Tensor:
    """Direction of a bar's axis (body x) up to its sign, ``[N, 2]``: a frequency-2 vector.

    (x + i y)^2 of the axis's horizontal part: (cos 2 yaw, sin 2 yaw) for a bar that lies flat,
    shorter for one that stands up.
    """
    axis = quaternion_to_matrix(q)[:, :2, 0]
    x, y = axis.unbind(dim=1)
    return torch.stack([x * x - y * y, 2 * x * y], dim=1)


def grasp_yaw(tcp_q: torch.Tensor, cube_q: torch.Tensor) -> dict[str, torch.Tensor]:
    """Cosine and sine ``[N, 1]`` of four times the yaw from the fingers to the cube's faces."""
    axis = quaternion_to_matrix(tcp_q)[:, :2, 0]
    return _yaw_between(_fourth_power(axis[:, 0], axis[:, 1]), fourfold_yaw(cube_q))


def bar_grasp_yaw(tcp_q: torch.Tensor, bar_q: torch.Tensor) -> dict[str, torch.Tensor]:
    """Cosine and sine ``[N, 1]`` of twice the yaw from the fingers to a bar (its body x axis)."""
    return _yaw_between(twofold_yaw(tcp_q), twofold_yaw(bar_q))


def _yaw_between(gripper: torch.Tensor, thing: torch.Tensor) -> dict[str, torch.Tensor]:
    cosine = (gripper * thing).sum(dim=1, keepdim=True)
    sine = gripper[:, :1] * thing[:, 1:] - gripper[:, 1:] * thing[:, :1]
    return {"grasp_yaw_cos": cosine, "grasp_yaw_sin": sine}


def _fourth_power(x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Real and imaginary part of (x + i y)^4 along a new last axis."""
    re, im = x * x - y * y, 2 * x * y
    return torch.stack([re * re - im * im, 2 * re * im], dim=-1)


def disc(u: np.ndarray, radius: float) -> np.ndarray:
    """Points ``[N, 2]`` uniform in a disc about the centre, from uniform numbers ``u [N, 2]``."""
    r, bearing = radius * np.sqrt(u[:, 0]), 2 * np.pi * u[:, 1]
    return np.stack([r * np.cos(bearing), r * np.sin(bearing)], axis=1)


def ahead_of(yaw: np.ndarray) -> np.ndarray:
    """Unit vectors ``[N, 2]`` in the direction ``yaw [N]`` (rad)."""
    return np.stack([np.cos(yaw), np.sin(yaw)], axis=1)


def pair(
    u: np.ndarray, radius: float, distance: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    """Two points ``[N, 2]`` whose midpoint is uniform in a disc and whose bearing is uniform.

    Args:
        u: uniform numbers ``[N, 4]``.
        radius: of the disc, metres.
        distance: between the points, from and to, metres.
    """
    low, high = distance
    half = (low + (high - low) * u[:, 3]) / 2
    middle, offset = disc(u[:, :2], radius), half[:, None] * ahead_of(2 * np.pi * u[:, 2])
    return middle + offset, middle - offset


def left_of(ahead: Any) -> Any:
    """Horizontal vectors ``[N, 2]``, array or tensor, turned by a quarter turn."""
    left = ahead[:, [1, 0]]
    left[:, 0] *= -1
    return left


def flat_pose(xy: np.ndarray, z: np.ndarray | float, yaw: np.ndarray, device: Any) -> Pose:
    """Poses upright at ``xy [N, 2]``, height ``z`` (m), turned by ``yaw [N]`` (rad)."""
    zero = np.zeros_like(yaw)
    p = np.concatenate([xy, np.broadcast_to(z, yaw.shape)[:, None]], axis=1)
    q = np.stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], axis=1)
    return Pose.create_from_pq(
        torch.as_tensor(p, dtype=torch.float32, device=device),
        torch.as_tensor(q, dtype=torch.float32, device=device),
    )


def goal_disc_pose(xy: np.ndarray, yaw: np.ndarray, device: Any) -> Pose:
    """Poses of ManiSkill's target discs, flat on the table at ``xy [N, 2]``.

    A disc's axis is its body x axis; its body z axis is laid into the direction ``yaw [N]``
    (rad), so that the pose holds a direction that is not visible.
    """
    upright = flat_pose(xy, 1e-3, yaw, device)
    flat = upright.q.new_tensor([np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0]).expand_as(upright.q)
    return Pose.create_from_pq(upright.p, quaternion_multiply(upright.q, flat))
