"""Fields that the observations of several tasks have."""

from __future__ import annotations

import torch

from symsteer.policies.geometry import Field

GRASP_YAW = (Field("grasp_yaw_cos", 0), Field("grasp_yaw_sin", 0, odd=True))
"""Of ``grasp_yaw`` and ``bar_grasp_yaw`` in the module ``features``."""


def vector_fields(*names: str) -> tuple[Field, ...]:
    """Fields of vectors in space: a horizontal and a vertical part of each."""
    return tuple(f for name in names for f in (Field(f"{name}_xy", 1), Field(f"{name}_z", 0)))


def in_parts(**vectors: torch.Tensor) -> dict[str, torch.Tensor]:
    """Vectors ``[N, 3]`` as the parts that :func:`vector_fields` names."""
    found: dict[str, torch.Tensor] = {}
    for name, vector in vectors.items():
        found |= {f"{name}_xy": vector[:, :2], f"{name}_z": vector[:, 2:]}
    return found
