"""Messages between the caller's process and its workers."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field
from typing import Any

SAME, RESULT, MISTAKE, FAILURE = b"=", b"!", b"?", b"x"
"""First byte of an answer. SAME: fields and skeleton equal those of the last answer to this
request, only the numbers in the shared memory are new. RESULT: fields and skeleton follow.
MISTAKE: the text of a `UserError`. FAILURE: summary and traceback of another error."""


@dataclass(frozen=True)
class Recipe:
    """How a worker makes its environments.

    Attributes:
        env_cls: the task class, not yet bound to a simulator.
        start: index of the shard's first environment among all.
        count: how many environments it holds.
        seed: of the process's global random generators.
        kwargs: further arguments of `environment.create_in_process`.
    """

    env_cls: type
    start: int
    count: int
    seed: int
    kwargs: dict[str, Any] = field(default_factory=dict)


def divide(total: int, workers: int) -> list[slice]:
    """Rows of each worker: sizes differ by at most one, larger ones first."""
    size, more = divmod(total, workers)
    bounds = [i * size + min(i, more) for i in range(workers + 1)]
    return [slice(a, b) for a, b in itertools.pairwise(bounds)]
