"""What rays meet: the convex solids of a scene, for pictures that no renderer draws.

A ray that meets a convex shape is a few multiplications for each facet: exact, and without a Vulkan
driver.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import sapien.physx as physx
import torch
from mani_skill.utils.structs import Actor, Pose

from symsteer.bench.sim.rotations import quaternion_to_matrix
from symsteer.bench.tasks.base import SymmetricTask
from symsteer.errors import UserError
from symsteer.policies.geometry import Field

Components: TypeAlias = Sequence[torch.Tensor]
"""x, y and z of many vectors; each has as many axes, the first for the environments, of any size
that broadcasts."""

FACETS = 24
"""Of the side of a cylinder."""

PARALLEL = 1e-6
"""Rays that approach a facet less than this in a unit of length do not cross it."""


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

    def span(
        self, pose: Pose, origin: Components, direction: Components
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Where rays enter it and where they leave it, ``[N, ...]`` in units of ``direction``.

        A ray that misses it enters at infinity and leaves at minus infinity.

        Args:
            pose: of the body, N rows.
            origin: metres in the world.
            direction: in the world.
        """
        normals = self.normals.to(pose.p) @ quaternion_to_matrix(pose.q).mT
        offsets = self.offsets.to(pose.p) + (normals * pose.p[:, None]).sum(-1)
        ones = (1,) * (origin[0].dim() - 1)
        near = pose.p.new_full((1, *ones), -torch.inf)
        far, inside = -near, torch.ones_like(near, dtype=torch.bool)
        for normal, offset in zip(normals.unbind(1), offsets.unbind(1), strict=True):
            parts = [part.view(-1, *ones) for part in normal.unbind(1)]
            room = offset.view(-1, *ones) - _dot(parts, origin)
            speed = _dot(parts, direction)
            bound = room / torch.where(speed.abs() > PARALLEL, speed, 1.0)
            far = torch.where(speed > PARALLEL, torch.minimum(far, bound), far)
            near = torch.where(speed < -PARALLEL, torch.maximum(near, bound), near)
            inside = inside & ((speed.abs() > PARALLEL) | (room >= 0))
        met = inside & (near <= far)
        return torch.where(met, near, torch.inf), torch.where(met, far, -torch.inf)


def _dot(a: Sequence[torch.Tensor], b: Components) -> torch.Tensor:
    """Sums of products; one by one, so that an axis of size 1 stays so for as long as it can."""
    return a[2] * b[2] + a[1] * b[1] + a[0] * b[0]


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
                f"a picture needs boxes, cylinders and convex meshes, and {body.name} has a "
                f"{type(shape).__name__}; describe it by those"
            )
        local = shape.local_pose.to_transformation_matrix()
        normals = normals @ local[:3, :3].T
        offsets = offsets + normals @ local[:3, 3]
        yield Solid(body, *(torch.as_tensor(a, dtype=torch.float32) for a in (normals, offsets)))


class Scenery(SymmetricTask):
    """Mixin of the tasks whose bodies are met by rays; list it before the class of a task.

    Of the task's fields only those that are in ``task_fields`` are told, such as the goal. Variants
    of perception move bodies before the rays as they move their poses.
    """

    _solids: tuple[Any, list[Solid]] = (None, [])

    def spans(
        self, origin: Components, direction: Components
    ) -> Iterator[tuple[torch.Tensor, torch.Tensor]]:
        """:meth:`Solid.span` of every part of every body but robot and furniture."""
        for solid in self._scenery():
            there, pose = self._everywhere(solid.body)
            near, far = solid.span(self.seen(pose, "object"), origin, direction)
            there = there.view(-1, *(1,) * (near.dim() - 1))
            yield torch.where(there, near, torch.inf), torch.where(there, far, -torch.inf)

    def _scenery(self) -> list[Solid]:
        """Found once for each scene."""
        scene, solids = self._solids
        if scene is not self.scene:
            furniture = (self.table_scene.table, self.table_scene.ground)
            bodies = [body for body in self.scene.actors.values() if body not in furniture]
            solids = [solid for body in bodies if body._bodies for solid in solids_of(body)]
            self._solids = self.scene, solids
        return solids

    def _everywhere(self, body: Actor) -> tuple[torch.Tensor, Pose]:
        """In which environments a body is, ``[N]`` bool, and its poses in all of them."""
        rows = body._scene_idxs.to(self.device)
        there = torch.zeros(self.num_envs, dtype=torch.bool, device=self.device)
        there[rows] = True
        raw = torch.zeros(self.num_envs, 7, device=self.device)
        raw[:, 3] = 1
        raw[rows] = body.pose.raw_pose
        return there, Pose.create(raw)


def pictured(picture: str, side: int, task: type[SymmetricTask], *kept: str) -> tuple[Field, ...]:
    """Fields of a task with a picture, of ``side * side`` pixels, in place of what it shows.

    Args:
        picture: name of its field.
        side: pixels in a row and in a column.
        task: with poses.
        kept: fields of the task that the picture does not show.
    """
    shown = Field(picture, 0, side * side)
    return shown, *(field for field in task.task_fields if field.name in kept)
