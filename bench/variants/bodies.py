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


STACK_ITERATIONS = 35


def prepare_for_force(body: Actor, where: torch.Tensor, stacks: bool) -> None:
    """Let a body rest under a steady horizontal force that friction can hold.

    A round body may not roll about horizontal axes. What may stand on other bodies gets more
    iterations of the solver: with ManiSkill's 15, stacked cubes on a slope do not move, but have
    velocities of 2 cm/s left over, which ManiSkill's test of rest (1 cm/s) takes for motion.

    Call it while the scene is being built: on CUDA neither can be changed later.

    Args:
        body: dynamic.
        where: environments, ``[N]`` bool.
        stacks: whether there are several dynamic bodies; their physics takes half as long again.
    """
    for scene, part in zip(body._scene_idxs.tolist(), body._bodies, strict=True):
        if where[scene]:
            if stacks:
                part.set_solver_position_iterations(STACK_ITERATIONS)
            if any(isinstance(shape, ROUND) for shape in part.collision_shapes):
                part.set_locked_motion_axes([False, False, False, True, True, False])
