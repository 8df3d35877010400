"""A region of the table is rough."""

from __future__ import annotations

import torch
from mani_skill.utils.structs import Actor

from symsteer.bench.variants.base import Variant

CENTER = (0.1, 0.0)
RADIUS = 0.1


class FrictionPatch(Variant):
    """Friction with the table is higher by 0.75 * strength in a disc of 10 cm radius at (0.1, 0).

    For ManiSkill's cubes on its table that is 0.3 outside and 0.3 + 0.75 * strength inside. A body
    counts as inside while its origin is; before each control step its own material gets
    1.5 * strength more (PhysX takes the mean of two materials), so that fingers hold it better
    there too. What rests on the patch stays there, also with ``gravity_tilt``. It matters where
    objects are pushed or pulled over the table; it hardly changes how one is lifted out of the
    disc.

    Breaks the dynamics of objects, in a region; the mirror image in the x axis survives. On CUDA
    the coefficients are written to PhysX's materials while the simulation runs, which has not been
    tried there.
    """

    def friction(self, body: Actor) -> torch.Tensor | None:
        env = self.env
        # Poses can be read once the simulation has started.
        if body is env.table_scene.table or not env.scene._gpu_sim_initialized:
            return None
        xy = body.pose.p[:, :2]
        inside = (xy - xy.new_tensor(CENTER)).norm(dim=1) < RADIUS
        return 1.5 * self.amount * inside
