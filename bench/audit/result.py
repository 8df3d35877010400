"""Settings and result of an audit, as plain data; docs/audit.md defines every number."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import torch
from pydantic import TypeAdapter, ValidationError

from symsteer.bench.audit.estimates import Estimate
from symsteer.bench.sim.environment import Simulator
from symsteer.bench.tasks import check_embodiment, task_class
from symsteer.bench.variants import read
from symsteer.errors import UserError
from symsteer.policies.geometry import Group
from symsteer.variant import file_name

VERSION = 1

Visitors = Literal["both", "expert", "policy"]

LEAST_STATES = 8
"""Subsets of the states with fewer are left out."""

BIN = 0.05
"""Side of a square of the map, metres."""


def check_group(name: str) -> Group:
    """Parse the name of a finite group with at least two elements.

    Raises:
        UserError: the group is unknown, infinite or trivial.
    """
    group = Group.parse(name)
    if group.order < 2:
        raise UserError(
            f"{name} has only the identity, so there is nothing to compare; choose C2 to C99 or "
            "D2 to D99, e.g. C8"
        )
    return group


@dataclass(frozen=True)
class AuditSettings:
    """What an audit measures, and how finely."""

    task: str = "PickCube-v1"
    embodiment: str = "floating"
    variant: str = "none"
    group: str = "C8"
    states: Visitors = "both"
    count: int = 32
    """States of each visitor."""
    chunk: int = 4
    """Steps of an action chunk."""
    resets: int = 256
    """Resets that are compared with as many turned ones."""
    seed: int = 0
    sim: Simulator = "cpu"

    def check(self) -> None:
        """Check everything before anything is built.

        Raises:
            UserError: an unknown task, embodiment, variant or group, CUDA is missing, or a number
                is out of range.
        """
        task_class(self.task)
        check_embodiment(self.embodiment)
        read(self.variant)
        check_group(self.group)
        for name, least in (("count", LEAST_STATES), ("chunk", 1), ("resets", 16)):
            if getattr(self, name) < least:
                raise UserError(f"{name} is {getattr(self, name)}; it must be at least {least}")
        if not 0 <= self.seed < 2**32:
            raise UserError(f"seed is {self.seed}; it must lie in [0, 2^32)")
        if self.chunk > task_class(self.task).max_episode_steps:
            raise UserError(
                f"a chunk of {self.chunk} steps is longer than an episode of {self.task}; "
                "use a smaller --chunk"
            )
        if self.sim == "cuda" and not torch.cuda.is_available():
            raise UserError("--sim cuda needs a GPU, but torch finds no CUDA device; use cpu")

    @property
    def name(self) -> str:
        """Name of the folder of results."""
        return f"{self.task}-{self.embodiment}-{file_name(self.variant)}-{self.group}"

    @property
    def visitors(self) -> tuple[Literal["expert", "policy"], ...]:
        """Who visits the states."""
        return ("expert", "policy") if self.states == "both" else (self.states,)


@dataclass(frozen=True)
class Defect:
    """Dynamics defect of one body over one window, for one subset of the states."""

    body: Literal["tool", "object"]
    window: Literal["step", "chunk"]
    subset: Literal["all", "expert", "policy", "still", "moving"]
    states: int
    relative: Estimate | None
    mm: Estimate
    degrees: Estimate
    displacement_mm: float
    floor_mm: float
    floor_degrees: float
    p95_mm: float


@dataclass(frozen=True)
class FieldDefect:
    """Observation defect of one field; ``value`` is in mm if ``unit`` is."""

    name: str
    unit: Literal["mm", ""]
    value: Estimate
    relative: float | None


@dataclass(frozen=True)
class Bin:
    """A square of the map: mean distance of its copies to their orbit's medoid after a chunk."""

    body: Literal["tool", "object"]
    x_mm: float
    y_mm: float
    copies: int
    mm: float


@dataclass(frozen=True)
class AuditResult:
    """All numbers of the audit of one task, embodiment and variant."""

    settings: AuditSettings
    base_policy: str | None
    """Beginning of the content hash of the policy that visited states."""
    states: int
    moving: int
    unreachable: float
    origin_mm: tuple[float, float]
    dynamics: tuple[Defect, ...]
    reward: dict[str, Estimate]
    observation: Estimate
    fields: tuple[FieldDefect, ...]
    random_observation: bool
    resets: Estimate
    resets_p: float
    map: tuple[Bin, ...] = ()
    seconds: float = 0.0
    version: int = field(default=VERSION)

    def defect(
        self,
        body: Literal["tool", "object"],
        window: Literal["step", "chunk"] = "step",
        subset: str = "all",
    ) -> Defect | None:
        """An entry of ``dynamics``, or None if the subset has too few states."""
        rows = (d for d in self.dynamics if (d.body, d.window, d.subset) == (body, window, subset))
        return next(rows, None)

    @property
    def worst_field(self) -> FieldDefect | None:
        """The position field with the largest defect."""
        positions = [f for f in self.fields if f.unit == "mm"]
        return max(positions, key=lambda f: f.value.value, default=None)

    def to_json(self) -> dict[str, Any]:
        """Nested plain data, numbers to six significant digits."""
        return _rounded(dataclasses.asdict(self))

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> AuditResult:
        """Inverse of `to_json`.

        Raises:
            UserError: the data are damaged or have another version.
        """
        version = data.get("version") if isinstance(data, dict) else None
        if version not in (None, VERSION):
            raise UserError(
                f"the audit has version {version}, but this SymSteer reads version {VERSION}; run "
                "the audit again"
            )
        try:
            return TypeAdapter(cls).validate_python(data)
        except ValidationError as error:
            first = error.errors()[0]
            where = ".".join(map(str, first["loc"]))
            raise UserError(
                f"an audit file is damaged ({where}: {first['msg']}); run the audit again"
            ) from error


def _rounded(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {key: _rounded(value) for key, value in tree.items()}
    if isinstance(tree, Sequence) and not isinstance(tree, str):
        return [_rounded(value) for value in tree]
    if isinstance(tree, float):
        return float(f"{tree:.6g}")
    return tree
