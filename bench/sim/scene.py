"""ManiSkill's scene over batched CPU physics."""

from __future__ import annotations

from typing import Any

import torch
from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.building.actor_builder import ActorBuilder
from mani_skill.utils.structs.render_camera import RenderCamera

from symsteer.bench.sim.physx import BatchedPhysx
from symsteer.bench.sim.rendering import RenderGroup


class BatchedScene(ManiSkillScene):
    """A `ManiSkillScene` whose physics system is a `BatchedPhysx`.

    Takes the arguments of `ManiSkillScene`; ``sub_scenes`` hold one ``PhysxCpuSystem`` each.
    """

    batched_cpu = True
    """Tells the patches of ManiSkill's classes that this scene is ours."""

    px: BatchedPhysx

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.px = BatchedPhysx(self.sub_scenes)
        self.gpu_sim_enabled = True

    def create_actor_builder(self) -> ActorBuilder:
        # On the GPU all scenes share one space, and ManiSkill builds one ground plane. Here every
        # scene needs its own.
        return super().create_actor_builder().set_allow_overlapping_plane_collisions(True)

    def _setup(self, enable_gpu: bool) -> None:
        """Start the simulation at the initial poses, at rest.

        As in ManiSkill, but without asking for the row of every link: rows are kept up to date
        once they have been asked for, which costs time.
        """
        self.px.gpu_init()
        self.non_static_actors = [a for a in self.actors.values() if a.px_body_type != "static"]
        for actor in self.non_static_actors:
            actor.set_pose(actor.initial_pose)
        for articulation in self.articulations.values():
            articulation.set_pose(articulation.initial_pose)
        for velocity in (
            self.px.cuda_rigid_body_data.torch()[:, 7:],
            self.px.joints["qvel"].torch(),
            self.px.joints["qf"].torch(),
        ):
            torch.zero_(velocity)
        self._gpu_sim_initialized = True
        self.px.apply_all()
        self.px.fetch_all()

    def _gpu_apply_all(self) -> None:
        self.px.apply_all()

    def _gpu_fetch_all(self) -> None:
        self.px.fetch_all()

    def add_camera(self, *args: Any, **kwargs: Any) -> RenderCamera:
        """Add a camera to every scene; takes the arguments of `ManiSkillScene.add_camera`."""
        # A mounted camera must follow its entity, as on the CPU, not a row of a CUDA buffer.
        self.gpu_sim_enabled = False
        try:
            return super().add_camera(*args, **kwargs)
        finally:
            self.gpu_sim_enabled = True

    def _setup_gpu_rendering(self) -> None:
        self.render_system_group = RenderGroup(self.sub_scenes, self.px)
