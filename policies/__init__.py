"""Base policies: frozen decoders from observation and noise to a chunk of actions.

``POLICIES`` is the registry. A policy of one's own is a class that inherits from
:class:`ChunkPolicy` (docs/policies.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from symsteer.lazy import lazily
from symsteer.registry import Registry

if TYPE_CHECKING:
    from symsteer.policies.contract import ChunkPolicy, Episode, PolicyOptions
    from symsteer.policies.files import load_policy, save_policy
    from symsteer.policies.geometry import Field, Group, Layout
    from symsteer.policies.normalizer import Normalizer, clip_blocks
    from symsteer.policies.training.demonstrations import make_chunks
    from symsteer.policies.training.denoising import DiffusionPolicy
    from symsteer.policies.training.gradient import GradientOptions, GradientPolicy

__all__ = [
    "POLICIES",
    "ChunkPolicy",
    "DiffusionPolicy",
    "Episode",
    "Field",
    "GradientOptions",
    "GradientPolicy",
    "Group",
    "Layout",
    "Normalizer",
    "PolicyOptions",
    "clip_blocks",
    "load_policy",
    "make_chunks",
    "save_policy",
]

__getattr__ = lazily(
    __name__,
    {
        "ChunkPolicy": "contract",
        "DiffusionPolicy": "training.denoising",
        "Episode": "contract",
        "Field": "geometry",
        "GradientOptions": "training.gradient",
        "GradientPolicy": "training.gradient",
        "Group": "geometry",
        "Layout": "geometry",
        "Normalizer": "normalizer",
        "PolicyOptions": "contract",
        "clip_blocks": "normalizer",
        "load_policy": "files",
        "make_chunks": "training.demonstrations",
        "save_policy": "files",
    },
)

POLICIES: Registry[type[ChunkPolicy]] = Registry(
    "policy",
    "symsteer.policies",
    {
        "edp": "symsteer.policies.symmetry.lifted:EquivariantDiffusionPolicy",
        "escnn": "symsteer.policies.symmetry.with_escnn:EscnnDiffusionPolicy",
        "frame-averaged": "symsteer.policies.symmetry.averaged:FrameAveragedDiffusionPolicy",
        "so2": "symsteer.policies.symmetry.steerable:PlanarSteerablePolicy",
        "spherical": "symsteer.policies.symmetry.steerable:SphericalPolicy",
        "canonical": "symsteer.policies.symmetry.canonical:CanonicalDiffusionPolicy",
        "plain": "symsteer.policies.symmetry.unconstrained:PlainDiffusionPolicy",
        "plain-augmented": "symsteer.policies.symmetry.augmented:AugmentedDiffusionPolicy",
        "edp-joint": "symsteer.policies.symmetry.joint:JointEquivariantPolicy",
        "plain-joint": "symsteer.policies.symmetry.joint:JointPlainPolicy",
        "edp-told": "symsteer.policies.symmetry.told:ToldEquivariantPolicy",
    },
    "symsteer.policies.contract:ChunkPolicy",
)
