"""A steady wind blows on what the robot has to move."""

from __future__ import annotations

import torch
from mani_skill.utils.structs import Actor

from symsteer.bench.variants.base import Variant
from symsteer.bench.variants.bodies import friction_of, masses, prepare_for_force


class Wind(Variant):
    """Pushes the manipulated object towards +x with 3/4 * strength of what friction holds.

    The force is 3/4 * strength * mu m g at the centre of mass in every substep, with the object's
    mass m and mu the mean of its and the table's static friction (PhysX's rule, before other
    variants raise it), at most 1: for a cube of ManiSkill, 64 g with mu 0.3, 0.14 N at strength 1.
    At rest friction holds against it (from 80 % of mu m g on PhysX lets cubes slip by up to 1 mm,
    and beyond the weight also an object with mu 1.65); once the object slides or hangs in the air
    it drifts downwind. A round object does not roll about horizontal axes where the strength is
    above zero.

    Breaks the dynamics of one object, everywhere; the mirror image in the x axis survives.
    """

    def load_scene(self) -> None:
        body, table, n = self.env.manipulated, self.env.table_scene.table, self.env.num_envs
        prepare_for_force(body, self.active, stacks=len(self.env.moving_bodies) > 1)
        g = -float(self.env.sim_config.scene_config.gravity[2])
        friction = ((friction_of(body, n) + friction_of(table, n)) / 2).clamp(max=1)
        self.friction_of_table, self.weight = friction, masses(body, n) * g

    def force(self, body: Actor) -> torch.Tensor | None:
        if body is not self.env.manipulated:
            return None
        push = 0.75 * self.amount * self.friction_of_table * self.weight
        still = torch.zeros_like(push)
        return torch.stack([push, still, still], dim=1)
