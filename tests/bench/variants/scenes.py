"""Environments and actions for the tests of this folder."""

from __future__ import annotations

from typing import Any

import torch

from symsteer.bench.tasks import SymmetricTask
from tests.bench.shared import shared

G = 9.81
CONTROL_STEP = 0.05
"""Seconds."""


def scene(variant: str = "none", strength: Any = None, **options: Any) -> SymmetricTask:
    """Environments of PickCube (or of ``task``), one for each strength, after a reset."""
    count = len(strength) if torch.is_tensor(strength) else 2
    strength = tuple(strength.tolist()) if torch.is_tensor(strength) else strength
    options = {"task": "PickCube-v1", "num_envs": count, **options}
    env = shared(variant=variant, strength=strength, **options)
    env.reset(seed=list(range(env.num_envs)), options={"reconfigure": True})
    return env


def act(env: SymmetricTask, **values: tuple[float, ...] | float) -> torch.Tensor:
    """Actions ``[N, 7]`` that are zero but for the named fields; fingers open by default."""
    action = torch.zeros(env.num_envs, env.action_layout.dim)
    for name, value in {"gripper": 1.0, **values}.items():
        action[:, env.action_layout.slice(name)] = torch.tensor(value)
    return action


def place(env: SymmetricTask, xyz: tuple[float, ...], velocity: tuple[float, ...] = (0, 0, 0)):
    """Put the manipulated object, level, at a point (m) with a velocity (m/s), in all scenes."""
    state = env.get_state_dict()
    body = state["actors"][env.manipulated.name]
    body[:] = torch.tensor([*xyz, 1.0, 0, 0, 0, *velocity, 0, 0, 0])
    env.set_state_dict(state)


def fields(env: SymmetricTask, obs: torch.Tensor) -> dict[str, torch.Tensor]:
    """The observation by field."""
    layout = env.observation_layout
    return {field.name: obs[:, layout.slice(field.name)] for field in layout.fields}
