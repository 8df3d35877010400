"""Tasks that are seen from above: the observation has a map of heights in place of poses.

The map is what depth cameras around the workspace make together: in each pixel the height of what
stands there, metres above the table. The table and the robot are cut off (a lab knows both). It is
computed from the bodies' collision shapes, by a vertical ray through each pixel: exact, without a
Vulkan driver, and in less than a millisecond.

A map is a field of the layout, ``picture_height``. Quarter turns about the centre turn pixels into
pixels; other turns interpolate (:class:`symsteer.policies.geometry.Picture`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import sapien.physx as physx
import torch
from mani_skill.utils.structs import Actor, Pose

from symsteer.bench.sim.rotations import quaternion_to_matrix
from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.tasks.move_cube import PushCube
from symsteer.bench.tasks.pick_cube import PickCube
from symsteer.errors import UserError
from symsteer.policies.geometry import PICTURE, PIXEL, Field

SIDE = 64
"""Pixels in a row and in a column: the map shows 32 cm on each side of the centre."""

RAYS = 2
"""Rays in a row and in a column of each pixel, whose heights are averaged."""

FACETS = 24
"""Of the side of a cylinder."""

VERTICAL = 1e-6
"""A facet whose normal rises less is a wall."""


@dataclass(frozen=True)
class Solid:
    """A convex part of a body: all points x with ``normals @ x <= offsets`` in the body's frame.

    Attributes:
        body: in some of the environments, or in all.
        normals: ``[F, 3]``.
        offsets: ``[F]`` metres.
    """

    body: Actor
    normals: torch.Tensor
    offsets: torch.Tensor

    def top(self, pose: Pose, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        """Height of its top above places in the world, 0 where it is not.

        Args:
            pose: of the body, N rows.
            x: ``[C]`` metres, of the columns.
            y: ``[R]`` metres, of the rows.

        Returns:
            ``[N, R, C]`` metres.
        """
        normals = self.normals.to(pose.p) @ quaternion_to_matrix(pose.q).mT
        offsets = self.offsets.to(pose.p) + (normals * pose.p[:, None]).sum(-1)
        low = pose.p.new_full((len(pose.p), len(y), len(x)), -torch.inf)
        high, inside = -low, torch.ones_like(low, dtype=torch.bool)
        for normal, offset in zip(normals.unbind(1), offsets.unbind(1), strict=True):
            nx, ny, nz = normal[:, :, None, None].unbind(1)
            room = offset[:, None, None] - ny * y[:, None] - nx * x
            bound = room / torch.where(nz.abs() > VERTICAL, nz, 1.0)
            high = torch.where(nz > VERTICAL, torch.minimum(high, bound), high)
            low = torch.where(nz < -VERTICAL, torch.maximum(low, bound), low)
            inside &= (nz.abs() > VERTICAL) | (room >= 0)
        return torch.where(inside & (low <= high), high, 0.0).clamp_min(0)


def solids_of(body: Actor) -> Iterator[Solid]:
    """The convex parts of a body's collision shapes.

    Raises:
        UserError: if a shape is neither a box nor a cylinder nor a convex mesh.
    """
    for shape in body._bodies[0].collision_shapes:
        if isinstance(shape, physx.PhysxCollisionShapeBox):
            normals = np.concatenate([np.eye(3), -np.eye(3)])
            offsets = np.tile(shape.half_size, 2)
        elif isinstance(shape, physx.PhysxCollisionShapeCylinder):
            angles = 2 * np.pi * np.arange(FACETS) / FACETS
            around = np.stack([0 * angles, np.cos(angles), np.sin(angles)], axis=1)
            normals = np.concatenate([around, [[1, 0, 0], [-1, 0, 0]]])
            offsets = np.array([shape.radius] * FACETS + [shape.half_length] * 2)
        elif isinstance(shape, physx.PhysxCollisionShapeConvexMesh):
            corners = (shape.vertices * shape.scale)[shape.triangles]
            normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            normals /= np.linalg.norm(normals, axis=1, keepdims=True)
            offsets = (normals * corners[:, 0]).sum(axis=1)
        else:
            raise UserError(
                f"a map of heights needs boxes, cylinders and convex meshes, and {body.name} has a "
                f"{type(shape).__name__}; describe it by those"
            )
        local = shape.local_pose.to_transformation_matrix()
        normals = normals @ local[:3, :3].T
        offsets = offsets + normals @ local[:3, 3]
        yield Solid(body, *(torch.as_tensor(a, dtype=torch.float32) for a in (normals, offsets)))


class Above(SymmetricTask):
    """Mixin; list it before the class of a task whose bodies are seen from above.

    Of the task's fields only those that are in ``task_fields`` are told, such as the goal. Variants
    of perception move bodies in the map as they move their poses.
    """

    _solids: tuple[Any, list[Solid]] = (None, [])

    def _observe_task(self) -> dict[str, torch.Tensor]:
        return {**super()._observe_task(), f"{PICTURE}height": self.heights().flatten(1)}

    def heights(self) -> torch.Tensor:
        """The present map, ``[N, SIDE, SIDE]`` metres; rows from +y to -y."""
        rays = SIDE * RAYS
        line = (torch.arange(rays, device=self.device) + 0.5) * (PIXEL / RAYS) - SIDE * PIXEL / 2
        found = torch.zeros(self.num_envs, rays, rays, device=self.device)
        for solid in self._scenery():
            there, pose = self._everywhere(solid.body)
            top = solid.top(self.seen(pose, "object"), line, -line)
            found = torch.maximum(found, top * there[:, None, None])
        return torch.nn.functional.avg_pool2d(found, RAYS)

    def _scenery(self) -> list[Solid]:
        """Of all bodies but the furniture, found once for each scene."""
        scene, solids = self._solids
        if scene is not self.scene:
            furniture = (self.table_scene.table, self.table_scene.ground)
            bodies = [body for body in self.scene.actors.values() if body not in furniture]
            solids = [solid for body in bodies if body._bodies for solid in solids_of(body)]
            self._solids = self.scene, solids
        return solids

    def _everywhere(self, body: Actor) -> tuple[torch.Tensor, Pose]:
        """In which environments a body is, ``[N]`` of 0 and 1, and its poses in all of them."""
        rows = body._scene_idxs.to(self.device)
        there = torch.zeros(self.num_envs, device=self.device)
        there[rows] = 1
        raw = torch.zeros(self.num_envs, 7, device=self.device)
        raw[:, 3] = 1
        raw[rows] = body.pose.raw_pose
        return there, Pose.create(raw)


def seen_from_above(kept: Sequence[Field]) -> tuple[Field, ...]:
    """Fields of a task that is seen from above: the map, and what it does not show."""
    return Field(f"{PICTURE}height", 0, SIDE * SIDE), *kept


class HeightPushCube(Above, PushCube):
    """Push a cube that a map of heights shows into a disc on the table, in any direction."""

    task_id = "HeightPushCube-v1"
    task_fields: ClassVar[tuple[Field, ...]] = seen_from_above(
        [f for f in PushCube.task_fields if f.name in ("goal_xy", "tcp_to_goal_xy")]
    )


class HeightPickCube(Above, PickCube):
    """Pick up a cube that a map of heights shows, and hold it at a goal in the air."""

    task_id = "HeightPickCube-v1"
    task_fields: ClassVar[tuple[Field, ...]] = seen_from_above(
        [f for f in PickCube.task_fields if f.name in ("goal_xy", "goal_z")]
    )
