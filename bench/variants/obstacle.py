"""A post stands on the table."""

from __future__ import annotations

import sapien
import torch

from symsteer.bench.variants.base import Variant

HALF_WIDTH, HEIGHT = 0.04, 0.2
GAP = 0.005


class Obstacle(Variant):
    """A fixed square post on the +x side, 8 x 8 x 20 cm * strength.

    Its axis stands 4.5 cm outside of the disc in which the task's objects are placed
    (``spawn_extent``), so that at strength 1 its face is 5 mm away from it; no reset touches it.
    It collides with robot and objects and is not observed. It is static and hence not part of
    simulation states: environments with and without it can exchange them.

    Breaks dynamics and reachability, in a region; the mirror image in the x axis survives. Scenes
    of different strength hold different bodies, which ManiSkill allows on CUDA too.
    """

    part_of_scene = True

    @property
    def position(self) -> tuple[float, float]:
        """Of the post's axis, metres in the world."""
        x, y = self.env.workspace_center
        return x + self.env.spawn_extent + GAP + HALF_WIDTH, y

    def load_scene(self) -> None:
        for i, size in enumerate(self.amount.unique().tolist()):
            if size == 0:
                continue
            half = [size * HALF_WIDTH, size * HALF_WIDTH, size * HEIGHT / 2]
            builder = self.env.scene.create_actor_builder()
            builder.add_box_collision(half_size=half)
            builder.add_box_visual(
                half_size=half, material=sapien.render.RenderMaterial(base_color=[0.3, 0.3, 0.3, 1])
            )
            builder.initial_pose = sapien.Pose(p=[*self.position, half[2]])
            builder.set_scene_idxs(torch.nonzero(self.amount == size).flatten().tolist())
            builder.build_static(name=f"{self.name}-{i}")
