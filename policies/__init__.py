"""Base policies: frozen decoders from observation and noise to a chunk of actions.

``POLICIES`` is the registry. A policy of one's own is a class that inherits from
:class:`symsteer.policies.contract.ChunkPolicy` (docs/policies.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from symsteer.registry import Registry

if TYPE_CHECKING:
    from symsteer.policies.contract import ChunkPolicy

__all__ = ["POLICIES"]

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
    },
    "symsteer.policies.contract:ChunkPolicy",
)
