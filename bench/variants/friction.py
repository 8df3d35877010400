"""Friction per environment: adds what variants want to the coefficients of bodies and table.

PhysX takes the mean of two shapes' coefficients where they touch (SAPIEN does not offer another
rule). A material may be shared between environments, so bodies in environments where a variant
acts on friction get materials of their own, before the simulation starts; all others keep theirs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import sapien.physx as physx
import torch
from mani_skill.utils.structs import Actor

from symsteer.bench.variants.base import Variant
from symsteer.bench.variants.world import World


@dataclass
class _Surface:
    """A body's own materials in the environments where a variant acts, with their first values."""

    body: Actor
    materials: dict[int, list[tuple[physx.PhysxMaterial, float, float]]]
    written: torch.Tensor


class Frictions:
    """Writes the friction of the dynamic bodies and the table as the variants change it.

    Args:
        env: whose scene is complete and not yet simulated.
        variants: those that add to friction.
    """

    def __init__(self, env: World, variants: Sequence[Variant]):
        self.variants = variants
        self.surfaces: list[_Surface] = []
        if not variants:
            return
        active = torch.stack([variant.active for variant in variants]).any(dim=0).tolist()
        for body in [env.table_scene.table, *env.moving_bodies]:
            materials = {
                scene: [_own_material(shape) for shape in part.collision_shapes]
                for scene, part in zip(body._scene_idxs.tolist(), body._bodies, strict=True)
                if active[scene]
            }
            self.surfaces.append(
                _Surface(body, materials, torch.zeros(env.num_envs, device=env.device))
            )
        self.update()

    def update(self) -> None:
        """Write the coefficients that have changed since they were last written."""
        for surface in self.surfaces:
            parts = [variant.friction(surface.body) for variant in self.variants]
            added = sum((p for p in parts if p is not None), torch.zeros_like(surface.written))
            for row in (added != surface.written).nonzero().flatten().tolist():
                extra = float(added[row])
                for material, static, dynamic in surface.materials[row]:
                    material.static_friction = static + extra
                    material.dynamic_friction = dynamic + extra
            surface.written = added


def _own_material(shape: physx.PhysxCollisionShape) -> tuple[physx.PhysxMaterial, float, float]:
    """Give a shape a copy of its material; also its static and dynamic friction."""
    old = shape.physical_material
    static, dynamic = old.static_friction, old.dynamic_friction
    shape.physical_material = physx.PhysxMaterial(
        static_friction=static, dynamic_friction=dynamic, restitution=old.restitution
    )
    return shape.physical_material, static, dynamic
