"""Patches of ManiSkill code that a subclass cannot replace.

Each patch looks at the scene: objects of a batched CPU scene use our code, all others use
ManiSkill's own, so stock environments can run in the same process. The patches depend on the
versions in `versions.TESTED`.
"""

from __future__ import annotations

from functools import cached_property, lru_cache, wraps
from typing import Any

import torch

from symsteer.bench.sim.contacts import is_grasping
from symsteer.bench.sim.kinematics import SerialChain


def is_batched(scene: Any) -> bool:
    """Whether a ManiSkill scene is a `BatchedScene`."""
    return getattr(scene, "batched_cpu", False)


def _dispatch_property(cls: type, name: str, ours: Any) -> None:
    stock = cls.__dict__[name].func

    def get(self: Any) -> Any:
        return ours(self) if is_batched(self.scene) else stock(self)

    get.__doc__ = stock.__doc__
    prop = cached_property(get)
    prop.__set_name__(cls, name)
    setattr(cls, name, prop)


@lru_cache(maxsize=1)
def install() -> None:
    """Install the patches, once per process."""
    from mani_skill.agents.controllers.utils.kinematics import Kinematics
    from mani_skill.agents.robots import Panda
    from mani_skill.envs.tasks.tabletop.push_t import WhiteTableSceneBuilder
    from mani_skill.utils.structs.articulation import Articulation
    from mani_skill.utils.structs.articulation_joint import ArticulationJoint
    from mani_skill.utils.structs.base import PhysxRigidBodyComponentStruct

    def body_rows(struct: Any) -> torch.Tensor:
        return torch.tensor([struct.px.body_index(b) for b in struct._bodies])

    def articulation_rows(struct: Any) -> torch.Tensor:
        objects = getattr(struct, "_physx_articulations", None) or struct._objs
        return torch.tensor([struct.px.articulation_index(a) for a in objects], dtype=torch.int32)

    _dispatch_property(PhysxRigidBodyComponentStruct, "_body_data_index", body_rows)
    _dispatch_property(Articulation, "_data_index", articulation_rows)
    _dispatch_property(ArticulationJoint, "_data_index", articulation_rows)

    stock_setup_cpu = Kinematics._setup_cpu

    def setup_cpu(self: Any) -> None:
        # ManiSkill chooses the batched solver by device type, but it works on CPU tensors too.
        if is_batched(self.articulation.scene):
            self._setup_gpu()
            self.pk_chain = SerialChain(self.pk_chain)
        else:
            stock_setup_cpu(self)

    Kinematics._setup_cpu = setup_cpu

    stock_grasping = Panda.is_grasping

    @wraps(stock_grasping)
    def grasping(self: Any, *args: Any, **kwargs: Any) -> torch.Tensor:
        found = is_grasping if is_batched(self.scene) else stock_grasping
        return found(self, *args, **kwargs)

    Panda.is_grasping = grasping

    stock_table = WhiteTableSceneBuilder.build

    def build_table(self: Any) -> None:
        # PushT repaints its table, which has no render component if nothing is rendered.
        if self.scene.can_render():
            stock_table(self)
        else:
            super(WhiteTableSceneBuilder, self).build()

    WhiteTableSceneBuilder.build = build_table
