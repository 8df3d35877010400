"""What tasks share: where things are placed, the fields of observations and their values."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from mani_skill.utils.structs import Pose

from symsteer.bench.sim.rotations import quaternion_multiply, quaternion_to_matrix
from symsteer.bench.variants.base import Role
from symsteer.policies.geometry import Field

GRASP_YAW = (Field("grasp_yaw_cos", 0), Field("grasp_yaw_sin", 0, odd=True))
"""Cosine and sine of the yaw from the fingers to the first thing of a task, times its ``turns``."""


@dataclass(frozen=True)
class Thing:
    """A body that a task's observation tells of."""

    actor: str
    """Attribute of the task that holds it."""
    role: Role = "object"
    turns: int = 1
    """In how many turns about the vertical it looks the same: 4 of a cube, 2 of a bar."""


def told(
    fields: Iterable[Field], poses: Mapping[str, Pose], things: Mapping[str, Thing]
) -> dict[str, torch.Tensor]:
    """Those fields ``[N, dim]`` whose names say what they are; all others are left out.

    With names ``A`` and ``B`` of poses these are ``A_xy`` and ``A_z``, the position of A;
    ``A_to_B_xy`` and ``A_to_B_z``, the vector from A to B; ``A_yaw``, up to A's turns; and those
    of :data:`GRASP_YAW`.

    Args:
        fields: of a task.
        poses: as the observation reports them; ``tcp`` is the tool.
        things: whose poses these are.
    """
    values: dict[str, torch.Tensor] = {}
    for field in fields:
        name, _, part = field.name.rpartition("_")
        start, _, end = name.rpartition("_to_")
        if field == GRASP_YAW[0]:
            first, thing = next(iter(things.items()))
            values |= grasp_yaw(poses["tcp"].q, poses[first].q, thing.turns)
        elif part == "yaw" and name in things:
            values[field.name] = yaw_up_to(things[name].turns, poses[name].q)
        elif part in ("xy", "z") and end in poses and (start in poses or not start):
            vector = poses[end].p - poses[start].p if start else poses[end].p
            values[field.name] = vector[:, :2] if part == "xy" else vector[:, 2:]
    return values


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


def yaw_up_to(turns: int, q: torch.Tensor) -> torch.Tensor:
    """Yaw of a body ``[N, 2]`` up to its symmetry: a vector of frequency ``turns``, 2 or 4.

    (x + i y)^turns of the horizontal part of a bar's axis (body x), or half the sum over the axes
    of a cube: (cos, sin) of ``turns`` yaw for a body that lies flat, the same for all ways to name
    its axes. That of a bar is shorter if it stands up.
    """
    axes = quaternion_to_matrix(q)[:, :2]
    if turns == 2:
        return _power(2, axes[:, 0, 0], axes[:, 1, 0])
    return _power(4, axes[:, 0], axes[:, 1]).sum(dim=1) / 2


def grasp_yaw(tcp_q: torch.Tensor, q: torch.Tensor, turns: int) -> dict[str, torch.Tensor]:
    """The fields ``[N, 1]`` of :data:`GRASP_YAW` for a body of ``turns``."""
    axis = quaternion_to_matrix(tcp_q)[:, :2, 0]
    gripper, thing = _power(turns, axis[:, 0], axis[:, 1]), yaw_up_to(turns, q)
    cosine = (gripper * thing).sum(dim=1, keepdim=True)
    sine = gripper[:, :1] * thing[:, 1:] - gripper[:, 1:] * thing[:, :1]
    return {"grasp_yaw_cos": cosine, "grasp_yaw_sin": sine}


def _power(turns: int, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
    """Real and imaginary part of (x + i y)^turns along a new last axis."""
    re, im = x * x - y * y, 2 * x * y
    if turns == 4:
        re, im = re * re - im * im, 2 * re * im
    return torch.stack([re, im], dim=-1)


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
