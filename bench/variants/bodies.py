"""What variants read off, and do to, SAPIEN's bodies; one value per environment."""

from __future__ import annotations

import sapien.physx as physx
import torch
from mani_skill.utils.structs import Actor

ROUND = (
    physx.PhysxCollisionShapeSphere,
    physx.PhysxCollisionShapeCapsule,
    physx.PhysxCollisionShapeCylinder,
)


def masses(body: Actor, num_envs: int) -> torch.Tensor:
    """Mass of a dynamic body, ``[N]`` kg; 0 where an environment lacks it."""
    values = torch.zeros(num_envs)
    for scene, part in zip(body._scene_idxs.tolist(), body._bodies, strict=True):
        values[scene] = part.mass
    return values.to(body.device)


def friction_of(body: Actor, num_envs: int) -> torch.Tensor:
    """Smallest static friction among the shapes of a body, ``[N]``; 0 where there is none."""
    values = torch.zeros(num_envs)
    for scene, part in zip(body._scene_idxs.tolist(), body._bodies, strict=True):
        shapes = part.collision_shapes
        values[scene] = min(shape.physical_material.static_friction for shape in shapes)
    return values.to(body.device)


def stop_rolling(body: Actor, where: torch.Tensor) -> None:
    """Lock rotations about horizontal axes of a round body; others are left alone.

    Call it while the scene is being built: on CUDA locks cannot be set later.

    Args:
        body: dynamic.
        where: environments, ``[N]`` bool.
    """
    for scene, part in zip(body._scene_idxs.tolist(), body._bodies, strict=True):
        if where[scene] and any(isinstance(shape, ROUND) for shape in part.collision_shapes):
            part.set_locked_motion_axes([False, False, False, True, True, False])
