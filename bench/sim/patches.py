"""The few places of ManiSkill that cannot be reached from a subclass.

Each patch dispatches on the scene: objects of a batched CPU scene take our path, all others
take ManiSkill's own code unchanged, so stock environments may run in the same process. They are
tied to the releases they were written against.
"""

from __future__ import annotations

from functools import cached_property, lru_cache
from importlib.metadata import version
from typing import Any

import torch

from symsteer.bench.sim.kinematics import SerialChain
from symsteer.bench.sim.pins import PINNED
from symsteer.errors import UserError


def check_versions() -> None:
    """Raise `UserError` unless the installed simulator is the one this package was written for."""
    for package, wanted in PINNED.items():
        if (found := version(package)) != wanted:
            raise UserError(
                f"SymSteer is written against {package} {wanted}, but {found} is installed: "
                f'run "pip install {package}=={wanted}".'
            )


def is_batched(scene: Any) -> bool:
    """Whether a ManiSkill scene is one of ours."""
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
    """Install the patches, once per process. Call `check_versions` first."""
    from mani_skill.agents.controllers.utils.kinematics import Kinematics
    from mani_skill.envs.tasks.tabletop.push_t import WhiteTableSceneBuilder
    from mani_skill.utils.structs.articulation import Articulation
    from mani_skill.utils.structs.articulation_joint import ArticulationJoint
    from mani_skill.utils.structs.base import PhysxRigidBodyComponentStruct

    def body_rows(struct: Any) -> torch.Tensor:
        return torch.tensor([struct.px.body_index(b) for b in struct._bodies])

    def articulation_rows(struct: Any) -> torch.Tensor:
        return torch.tensor(
            [struct.px.articulation_index(a) for a in struct._objs], dtype=torch.int32
        )

    def joint_rows(struct: Any) -> torch.Tensor:
        return torch.tensor(
            [struct.px.articulation_index(a) for a in struct._physx_articulations],
            dtype=torch.int32,
        )

    _dispatch_property(PhysxRigidBodyComponentStruct, "_body_data_index", body_rows)
    _dispatch_property(Articulation, "_data_index", articulation_rows)
    _dispatch_property(ArticulationJoint, "_data_index", joint_rows)

    stock_setup_cpu = Kinematics._setup_cpu

    def setup_cpu(self: Any) -> None:
        # The batched solver, which ManiSkill chooses by device type, works on CPU tensors too.
        if is_batched(self.articulation.scene):
            self._setup_gpu()
            self.pk_chain = SerialChain.replace(self.pk_chain)
        else:
            stock_setup_cpu(self)

    Kinematics._setup_cpu = setup_cpu

    stock_table = WhiteTableSceneBuilder.build

    def build_table(self: Any) -> None:
        # PushT repaints its table, which has no render component where nothing is rendered.
        if self.scene.can_render():
            stock_table(self)
        else:
            super(WhiteTableSceneBuilder, self).build()

    WhiteTableSceneBuilder.build = build_table
