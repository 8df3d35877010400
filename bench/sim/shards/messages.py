"""What the user's process and its workers say to each other."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import Any

SAME, RESULT, MISTAKE, FAILURE = b"=", b"!", b"?", b"x"
"""First byte of an answer: a result like the last one of this kind (the numbers lie in the shared
memory), a result, the text of a `UserError`, another error's summary and traceback."""


@dataclass(frozen=True)
class Recipe:
    """How a worker makes its environments.

    Attributes:
        env_cls: the task class, not yet bound to a simulator.
        start: index of the shard's first environment among all.
        count: how many environments it holds.
        seed: of the process's global random generators.
        kwargs: further arguments of `symsteer.bench.sim.create`.
    """

    env_cls: type
    start: int
    count: int
    seed: int
    kwargs: dict[str, Any] = field(default_factory=dict)


def divide(total: int, workers: int) -> list[slice]:
    """Rows of each worker: as even as can be, the first ones have one more."""
    size, more = divmod(total, workers)
    bounds = [i * size + min(i, more) for i in range(workers + 1)]
    return [slice(a, b) for a, b in itertools.pairwise(bounds)]
