"""Who executes the runs of sweeps and searches. Light to import."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import tyro


@dataclass(frozen=True)
class Workforce:
    """How many runs are executed at the same time, and where; options of the command line."""

    workers: int = 0
    """Number of runs at the same time; 0: one per core, or as many as fit on the cluster."""
    ray: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None
    """Address of a Ray cluster to run on: auto, or host:port of its head."""
    together: int = 1
    """Learners that share a process and are trained as one, which is faster, if they differ in
    seeds and variants alone."""


THIS_MACHINE = Workforce()
