"""Environments that tests share, since making one takes longer than most tests; comparisons."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch

from symsteer.bench.tasks import TASKS, SymmetricTask, make, task_class

STATE_TASKS = [name for name in TASKS.names() if not task_class(name).is_seen()]
"""The tasks that run without a Vulkan driver."""

FLAT_TASKS = [name for name in STATE_TASKS if not name.startswith("Tilted")]
"""Those of them on a level table."""


@lru_cache(maxsize=12)
def shared(
    task: str = "PickCube-v1", num_envs: int = 6, number: int = 0, **options: Any
) -> SymmetricTask:
    """Environments of a task that earlier tests have used: reset them, and do not close them.

    ``number`` tells several of the same kind apart.
    """
    return make(task, num_envs=num_envs, **options)


def roam(env: SymmetricTask, steps: int, seed: int = 0) -> None:
    """Random actions, so that states are general: tilted, moving, fingers half open."""
    generator = torch.Generator().manual_seed(seed)
    for _ in range(steps):
        env.step(torch.rand(env.num_envs, 7, generator=generator) * 2 - 1)


def assert_same(a: Any, b: Any) -> None:
    """Equal to the last bit, in structure, type and value."""
    if isinstance(a, dict):
        assert list(a) == list(b)
        for key in a:
            assert_same(a[key], b[key])
    elif isinstance(a, list | tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    elif isinstance(a, torch.Tensor):
        assert a.dtype == b.dtype
        assert torch.equal(a, b)
    else:
        assert a == b
