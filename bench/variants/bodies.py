"""Reads and changes SAPIEN's bodies for the variants; one value per environment."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any

import sapien.physx as physx
import torch
from mani_skill.utils.structs import Actor

from symsteer.bench.variants.base import Variant

ROUND = (
    physx.PhysxCollisionShapeSphere,
    physx.PhysxCollisionShapeCapsule,
    physx.PhysxCollisionShapeCylinder,
)


def masses(body: Actor, num_envs: int) -> torch.Tensor:
    """Mass of a dynamic body, ``[N]`` kg; 0 where an environment lacks it."""
    return _per_environment(body, num_envs, lambda part: part.mass)


def friction_of(body: Actor, num_envs: int) -> torch.Tensor:
    """Smallest static friction among the shapes of a body, ``[N]``; 0 where there is none."""

    def smallest(part: Any) -> float:
        return min(shape.physical_material.static_friction for shape in part.collision_shapes)

    return _per_environment(body, num_envs, smallest)


def _per_environment(body: Actor, num_envs: int, value: Callable[[Any], float]) -> torch.Tensor:
    values = torch.zeros(num_envs)
    for scene, part in _by_scene(body):
        values[scene] = value(part)
    return values.to(body.device)


def _by_scene(body: Actor) -> Iterator[tuple[int, Any]]:
    """Environments that have the body, and SAPIEN's body in each."""
    return zip(body._scene_idxs.tolist(), body._bodies, strict=True)


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
    for scene, part in _by_scene(body):
        if where[scene]:
            if stacks:
                part.set_solver_position_iterations(STACK_ITERATIONS)
            if any(isinstance(shape, ROUND) for shape in part.collision_shapes):
                part.set_locked_motion_axes([False, False, False, True, True, False])


class Frictions:
    """Writes the friction of the dynamic bodies and the table as variants want it.

    PhysX takes the mean of two shapes' coefficients where they touch (SAPIEN does not offer another
    rule). A material may be shared between environments, so bodies in environments where a variant
    acts on friction get materials of their own; all others keep theirs.

    Args:
        env: the task, whose scene is complete and not yet simulated.
        variants: those that add to friction.
    """

    def __init__(self, env: Any, variants: Sequence[Variant]):
        self.variants = variants
        # Of each body: by environment its materials with their first coefficients.
        self._materials: dict[Actor, dict[int, list[tuple[Any, float, float]]]] = {}
        self._written: dict[Actor, torch.Tensor] = {}
        if not variants:
            return
        active = torch.stack([variant.active for variant in variants]).any(dim=0).tolist()
        for body in [env.table_scene.table, *env.moving_bodies]:
            self._materials[body] = {
                scene: [_own_material(shape) for shape in part.collision_shapes]
                for scene, part in _by_scene(body)
                if active[scene]
            }
            self._written[body] = torch.zeros(env.num_envs, device=env.device)
        self.update()

    def update(self) -> None:
        """Write the coefficients that have changed since they were last written."""
        for body, written in self._written.items():
            wanted = [variant.friction(body) for variant in self.variants]
            added = sum((w for w in wanted if w is not None), torch.zeros_like(written))
            for row in (added != written).nonzero().flatten().tolist():
                for material, static, dynamic in self._materials[body][row]:
                    material.static_friction = static + float(added[row])
                    material.dynamic_friction = dynamic + float(added[row])
            self._written[body] = added


def _own_material(shape: physx.PhysxCollisionShape) -> tuple[Any, float, float]:
    """Give a shape a copy of its material; also its static and dynamic friction."""
    old = shape.physical_material
    static, dynamic = old.static_friction, old.dynamic_friction
    shape.physical_material = physx.PhysxMaterial(
        static_friction=static, dynamic_friction=dynamic, restitution=old.restitution
    )
    return shape.physical_material, static, dynamic
