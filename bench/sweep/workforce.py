"""Who executes the runs of sweeps and searches. Light to import."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import tyro


@dataclass(frozen=True)
class Workforce:
    """How many runs are executed at the same time, and where; options of the command line."""

    workers: Annotated[int | Literal["auto"], tyro.conf.arg(metavar="INT|auto")] = 0
    """Processes at the same time; 0: one per core, or as many as fit on the cluster; auto: measure
    first, for a minute or two, which number and which --together are fastest here."""
    ray: Annotated[str | None, tyro.conf.arg(metavar="ADDRESS")] = None
    """Address of a Ray cluster to run on: auto, or host:port of its head."""
    together: Annotated[int | None, tyro.conf.arg(metavar="INT")] = None
    """Learners that share a process and are trained as one, which is faster, if they differ in
    seeds and variants alone; default: 1."""


THIS_MACHINE = Workforce()
