"""ManiSkill's scene over batched CPU physics."""

from __future__ import annotations

from typing import Any

from mani_skill.envs.scene import ManiSkillScene
from mani_skill.utils.building.actor_builder import ActorBuilder

from bench.sim.physx import BatchedPhysx


class BatchedScene(ManiSkillScene):
    """A `ManiSkillScene` whose physics system is a `BatchedPhysx`.

    Takes the arguments of `ManiSkillScene`; ``sub_scenes`` hold one ``PhysxCpuSystem`` each.
    """

    batched_cpu = True
    """What the patches of ManiSkill's structs recognise."""

    px: BatchedPhysx

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.px = BatchedPhysx(self.sub_scenes)
        self.gpu_sim_enabled = True

    def create_actor_builder(self) -> ActorBuilder:
        # On the GPU all scenes share one space, so ManiSkill builds a ground plane once. Here
        # every scene needs its own.
        return super().create_actor_builder().set_allow_overlapping_plane_collisions(True)
