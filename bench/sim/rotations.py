"""Batched rotations on torch tensors: quaternions, matrices, Euler angles, planar symmetries.

Quaternions are (w, x, y, z) and unit length, as in SAPIEN. A planar symmetry is the pair
``(angle, reflect)`` of ``symsteer.policies.geometry``: first (x, y) -> (x, -y) if ``reflect``, then
a rotation by ``angle`` about the vertical axis. A body is mirrored together with its own frame,
R -> M R M with M = diag(1, -1, 1), so that rotations stay rotations; bodies that are their own
mirror image across their x-z plane (cubes, two-fingered grippers) look as mirrored bodies should.

The product of quaternions is ManiSkill's. Its conversions to matrices are not used: those of
quaternions and rotation vectors normalise again and round differently, which would change
results, and the one of Euler angles multiplies three matrices, whose rounding depends on the BLAS.
"""

from __future__ import annotations

import math
from functools import cache

import torch
from mani_skill.utils.geometry.rotation_conversions import (
    quaternion_raw_multiply as quaternion_multiply,
)

_PRODUCTS = "yxxxxyxyxzwwwzwwwy", "yyzyxzzzxzzyzzxyxy", "-+++-+++---++---+-"
"""Of each entry of R - 1, row by row: factors and sign of its first product, then of its second."""


def quaternion_to_matrix(q: torch.Tensor) -> torch.Tensor:
    """Rotation matrices ``[..., 3, 3]`` of unit quaternions ``[..., 4]``."""
    first, second, sign = _products(q.device)
    products = q.index_select(-1, first) * (q.index_select(-1, second) * sign)
    matrix = (products[..., :9] + products[..., 9:]).unflatten(-1, (3, 3))
    matrix.diagonal(dim1=-2, dim2=-1).add_(1)
    return matrix


@cache
def _products(device: torch.device) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Indices of the factors and signs times 2, ``[18]``: one operation costs less than nine."""
    *names, signs = _PRODUCTS
    first, second = (torch.tensor(["wxyz".index(n) for n in x], device=device) for x in names)
    return first, second, torch.tensor([float(f"{sign}2") for sign in signs], device=device)


def yaw_quaternion(yaw: torch.Tensor) -> torch.Tensor:
    """Quaternions ``[..., 4]`` of rotations by ``yaw [...]`` (rad) about the vertical axis."""
    zero = torch.zeros_like(yaw)
    return torch.stack([torch.cos(yaw / 2), zero, zero, torch.sin(yaw / 2)], dim=-1)


def rotation_vector_to_matrix(v: torch.Tensor) -> torch.Tensor:
    """Matrices ``[..., 3, 3]`` of rotations about ``v [..., 3]`` by ``|v|`` (rad)."""
    half = torch.linalg.vector_norm(v, dim=-1, keepdim=True) / 2
    # sin(h)/h is sinc(h/pi) in torch's convention and smooth at zero.
    return quaternion_to_matrix(
        torch.cat([torch.cos(half), v / 2 * torch.sinc(half / math.pi)], dim=-1)
    )


def euler_to_matrix(angles: torch.Tensor) -> torch.Tensor:
    """Rx(a) Ry(b) Rz(c) ``[..., 3, 3]`` of ``angles [..., 3]`` = (a, b, c)."""
    (ca, cb, cc), (sa, sb, sc) = torch.cos(angles).unbind(-1), torch.sin(angles).unbind(-1)
    rows = [
        [cb * cc, -cb * sc, sb],
        [ca * sc + sa * sb * cc, ca * cc - sa * sb * sc, -sa * cb],
        [sa * sc - ca * sb * cc, sa * cc + ca * sb * sc, ca * cb],
    ]
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)


def matrix_to_euler_facing_down(matrix: torch.Tensor, near: torch.Tensor) -> torch.Tensor:
    """The (a, b, c) of :func:`euler_to_matrix` with b close to pi (tool axis downwards).

    Args:
        matrix: ``[..., 3, 3]``, tool axis less than 90 degrees from straight down.
        near: ``[..., 3]``, earlier angles; a and c are returned without jumps of 2 pi from them.
    """
    # cos b < 0 there, which fixes the signs of both arc tangents.
    a = torch.atan2(matrix[..., 1, 2], -matrix[..., 2, 2])
    b = math.pi - torch.asin(matrix[..., 0, 2].clamp(-1, 1))
    c = torch.atan2(matrix[..., 0, 1], -matrix[..., 0, 0])
    a, c = unwrap(torch.stack([a, c], dim=-1), near[..., ::2]).unbind(-1)
    return torch.stack([a, b, c], dim=-1)


def unwrap(angle: torch.Tensor, near: torch.Tensor) -> torch.Tensor:
    """``angle`` plus the multiple of 2 pi that brings it closest to ``near``."""
    return near + wrap(angle - near, 2 * math.pi)


def wrap(angle: torch.Tensor, period: float) -> torch.Tensor:
    """``angle`` modulo ``period``, in [-period/2, period/2)."""
    return torch.remainder(angle + period / 2, period) - period / 2


def euler_rates_matrix(angles: torch.Tensor) -> torch.Tensor:
    """E ``[..., 3, 3]`` with (world angular velocity) = E (rates of a, b, c)."""
    ca, sa = torch.cos(angles[..., 0]), torch.sin(angles[..., 0])
    zero, one = torch.zeros_like(ca), torch.ones_like(ca)
    first = torch.stack([one, zero, zero], dim=-1)
    second = torch.stack([zero, ca, sa], dim=-1)
    return torch.stack([first, second, euler_to_matrix(angles)[..., :, 2]], dim=-1)


def planar_matrix(angle: float, reflect: bool, like: torch.Tensor) -> torch.Tensor:
    """The 3 x 3 matrix of (angle, reflect) on points, in ``like``'s dtype and device."""
    c, s = math.cos(angle), math.sin(angle)
    flip = -1.0 if reflect else 1.0
    return like.new_tensor([[c, -s * flip, 0.0], [s, c * flip, 0.0], [0.0, 0.0, 1.0]])


def transform_quaternion(
    q: torch.Tensor, angle: float, reflect: bool, across_yz: bool = False
) -> torch.Tensor:
    """Act with (angle, reflect) on orientations ``q [..., 4]``.

    Args:
        q: of bodies that are their own mirror image across their body x-z plane.
        angle: radians.
        reflect: whether (x, y) -> (x, -y) comes first.
        across_yz: the bodies' mirror plane is y-z instead.
    """
    if reflect:
        q = q * q.new_tensor([1.0, -1.0, 1.0, -1.0])
        if across_yz:
            # Mirroring the body's frame in x instead of y differs by half a turn about its z axis.
            q = quaternion_multiply(q, q.new_tensor([0.0, 0.0, 0.0, 1.0]).expand_as(q))
    return quaternion_multiply(yaw_quaternion(q.new_tensor(angle)).expand_as(q), q)


def transform_angular(w: torch.Tensor, angle: float, reflect: bool) -> torch.Tensor:
    """Act with (angle, reflect) on axial vectors ``w [..., 3]`` such as angular velocities."""
    sign = -1.0 if reflect else 1.0
    return sign * (w @ planar_matrix(angle, reflect, w).T)


def transform_body(
    state: torch.Tensor, angle: float, reflect: bool, across_yz: bool = False
) -> torch.Tensor:
    """Act with (angle, reflect) on rigid-body states ``[N, 13]``.

    Their columns are position, quaternion, velocity and angular velocity; ``across_yz`` is that of
    :func:`transform_quaternion`.
    """
    world = planar_matrix(angle, reflect, state)
    return torch.cat(
        [
            state[:, :3] @ world.T,
            transform_quaternion(state[:, 3:7], angle, reflect, across_yz),
            state[:, 7:10] @ world.T,
            transform_angular(state[:, 10:13], angle, reflect),
        ],
        dim=1,
    )
