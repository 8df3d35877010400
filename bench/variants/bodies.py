"""Reads and changes SAPIEN's bodies for the variants; one value per environment."""

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


STACK_ITERATIONS = 35


def prepare_for_force(body: Actor, where: torch.Tensor, stacks: bool) -> None:
    """Let a body rest under a constant horizontal force that friction can hold.

    A round body is kept from rolling about horizontal axes. Bodies that may be stacked get more
    iterations of the solver: with ManiSkill's 15, stacked cubes on a slope stay in place but keep
    velocities of 2 cm/s, which ManiSkill's test of rest (1 cm/s) counts as motion.

    Call it while the scene is being built: on CUDA neither can be changed later.

    Args:
        body: dynamic.
        where: environments, ``[N]`` bool.
        stacks: whether there are several dynamic bodies; their physics then takes 50 % longer.
    """
    for scene, part in zip(body._scene_idxs.tolist(), body._bodies, strict=True):
        if where[scene]:
            if stacks:
                part.set_solver_position_iterations(STACK_ITERATIONS)
            if any(isinstance(shape, ROUND) for shape in part.collision_shapes):
                part.set_locked_motion_axes([False, False, False, True, True, False])
