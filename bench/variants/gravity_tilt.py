"""The table stands at a slope."""

from __future__ import annotations

import math

import torch
from mani_skill.utils.structs import Actor

from symsteer.bench.variants.base import Variant
from symsteer.bench.variants.bodies import masses, prepare_for_force

MAX_TILT = math.radians(30)


class GravityTilt(Variant):
    """Gravity leans by 30 degrees * strength towards +x, as on a tilted table seen from the table.

    Each dynamic body of the task feels m (g_tilted - g) at its centre of mass in every substep.
    The robot's links feel no gravity in ManiSkill (its controllers compensate it), hence no tilt.
    Friction of bodies and table rises by 1.5 tan(tilt), so that untouched objects stay in place;
    round bodies, which friction cannot hold, do not roll about horizontal axes where the
    strength is above zero. A free object tips over once the slope exceeds half its width over
    the height of its centre: two stacked cubes at 27 degrees, an upright peg at 12.

    Breaks the dynamics of objects, everywhere; the mirror image in the x axis survives. On CUDA
    materials are written before the simulation starts, which PhysX needs.
    """

    @property
    def tilt(self) -> torch.Tensor:
        """Slope of each environment, ``[N]`` radians."""
        return MAX_TILT * self.amount

    def load_scene(self) -> None:
        bodies = self.env.moving_bodies
        for body in bodies:
            prepare_for_force(body, self.active, stacks=len(bodies) > 1)

    def force(self, body: Actor) -> torch.Tensor:
        g = -float(self.env.sim_config.scene_config.gravity[2])
        weight = (masses(body, self.env.num_envs) * g)[:, None]
        tilt = self.tilt
        change = torch.stack([tilt.sin(), torch.zeros_like(tilt), 1 - tilt.cos()], dim=1)
        return weight * change

    def friction(self, body: Actor) -> torch.Tensor:
        return 1.5 * self.tilt.tan()
