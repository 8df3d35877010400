"""Settings and result of an audit, as plain data; docs/audit.md defines every number."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, Literal, get_args

from pydantic import TypeAdapter, ValidationError

from symsteer.bench.audit.estimates import Measurement
from symsteer.bench.tasks import check_embodiment, task_class
from symsteer.bench.variants import read
from symsteer.errors import UserError, first_problem
from symsteer.policies.geometry import Group
from symsteer.variant import file_name

VERSION = 2
"""2: decisions (chunks) in place of single steps, horizontal motion by itself."""

Body = Literal["tool", "object"]
BODIES: tuple[Body, ...] = get_args(Body)

Part = Literal["tool", "object", "cost", "observation"]
"""A part of a decision; the largest defect of a part is the defect of the decision."""

Subset = Literal["all", "expert", "policy", "still", "moving"]
"""States by who visited them, or by whether the object moves."""

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


def old_version(version: Any) -> str:
    """What to say about results of another version."""
    return (
        f"the audit has version {version}, but this SymSteer reads version {VERSION}; run the "
        "audit again"
    )


@dataclass(frozen=True)
class AuditSettings:
    """What an audit measures, and how finely."""

    task: str = "PickCube-v1"
    embodiment: str = "floating"
    variant: str = "none"
    group: str = "C8"
    states: Literal["both", "expert", "policy"] = "both"
    """Who visits states."""
    count: int = 32
    """States of each visitor."""
    chunk: int = 4
    """Control steps of a decision: those that are executed of an action chunk."""
    resets: int = 256
    """Resets that are compared with as many turned ones."""
    seed: int = 0

    def check(self) -> None:
        """Check everything before anything is built.

        Raises:
            UserError: an unknown task, embodiment, variant or group, or a number is out of range.
        """
        task = task_class(self.task)
        if task.is_seen() and self.states == "expert":
            raise UserError(
                f"what cameras see of {self.task} is compared after the encoder of a base policy; "
                "leave --base-policy none out, so that one is trained, or name its file there"
            )
        check_embodiment(self.embodiment)
        for spec in read(self.variant):
            if not spec.is_constant:
                raise UserError(
                    f"{spec.text} has many strengths, but an audit measures one: "
                    f"give a number, e.g. {spec.name}:{spec.strength}"
                )
        group = check_group(self.group)
        if task.is_seen() and group.reflections:
            raise UserError(
                f"no encoder of what is seen has mirror symmetry, so under {group} the encoder "
                f"would be measured, not {self.task}; choose C_n, e.g. C{group.rotations}"
            )
        if self.count < LEAST_STATES:
            raise UserError(f"--states is {self.count}; it must be at least {LEAST_STATES}")
        if not 1 <= self.chunk <= task.max_episode_steps:
            raise UserError(
                f"a chunk of {self.chunk} steps does not fit into an episode of {self.task}, which "
                f"has {task.max_episode_steps}"
            )

    @property
    def name(self) -> str:
        """Name of the folder of results."""
        return f"{self.task}-{self.embodiment}-{file_name(self.variant)}-{self.group}"

    @property
    def visitors(self) -> tuple[Literal["expert", "policy"], ...]:
        """Who visits the states."""
        return ("expert", "policy") if self.states == "both" else (self.states,)


@dataclass(frozen=True)
class MotionDefect:
    """Dynamics defect of one body over a decision, for one subset of the states.

    Attributes:
        horizontal, vertical: of the tool's centre point, or of the object's corners (so of its
            pose), relative to their own displacement in this direction; None at rest.
        mm, degrees: distance of positions, angle between orientations.
        displacement_mm: mean distance that it moves.
        floor_mm, floor_degrees: what rounding alone does.
        p95_mm: 95th percentile of the distances over states and copies.
    """

    body: Body
    subset: Subset
    states: int
    horizontal: Measurement | None
    vertical: Measurement | None
    mm: Measurement
    degrees: Measurement
    displacement_mm: float
    floor_mm: float
    floor_degrees: float
    p95_mm: float


@dataclass(frozen=True)
class FieldDefect:
    """Observation defect of one field; ``value`` is in mm if ``unit`` is.

    ``relative`` is the share of the tool's horizontal displacement if the field is a length (None
    if the tool is at rest), and ``value`` else: such fields are of the order of 1.
    """

    name: str
    unit: Literal["mm", ""]
    value: Measurement
    relative: Measurement | None


@dataclass(frozen=True)
class Square:
    """A square of the map: mean distance of its copies to their orbit's medoid at the end."""

    body: Body
    x_mm: float
    y_mm: float
    copies: int
    mm: float


@dataclass(frozen=True)
class AuditResult:
    """All numbers of the audit of one task, embodiment and variant."""

    settings: AuditSettings
    base_policy: str | None
    """Beginning of the content hash of the policy that visited states and encoded what is seen."""
    states: int
    moving: int
    unreachable: float
    origin_mm: tuple[float, float]
    dynamics: tuple[MotionDefect, ...]
    reward: dict[str, Measurement]
    fields: tuple[FieldDefect, ...]
    random_observation: bool
    resets: Measurement
    resets_p: float
    map: tuple[Square, ...] = ()
    seconds: float = 0.0
    version: int = VERSION

    def defect(self, body: Body, subset: Subset = "all") -> MotionDefect | None:
        """An entry of ``dynamics``, or None if the subset has too few states."""
        return next((d for d in self.dynamics if (d.body, d.subset) == (body, subset)), None)

    @property
    def worst_field(self) -> FieldDefect:
        """The field of the observation with the largest relative defect."""
        # Rounded, so that fields that differ by rounding are a tie, and the first is named.
        return max(self.fields, key=lambda f: round(f.relative.value, 4) if f.relative else -1.0)

    @property
    def parts(self) -> dict[Part, Measurement]:
        """Defects of the parts of a decision, without those of bodies at rest."""
        tool, thing = self.defect("tool"), self.defect("object")
        defects: dict[Part, Measurement | None] = {
            "tool": tool.horizontal if tool else None,
            "object": thing.horizontal if thing else None,
            "cost": self.reward["cost"],
            "observation": self.worst_field.relative,
        }
        return {name: defect for name, defect in defects.items() if defect is not None}

    @property
    def part(self) -> Part:
        """The part with the largest defect, which is the defect of a decision."""
        return max(self.parts, key=lambda name: self.parts[name].value)

    @property
    def decision(self) -> Measurement:
        """The defect of a decision: the largest of its parts."""
        return self.parts[self.part]

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
            raise UserError(old_version(version))
        try:
            return TypeAdapter(cls).validate_python(data)
        except ValidationError as error:
            raise UserError(
                f"an audit file is damaged ({first_problem(error)}); remove it and run the audit "
                "again"
            ) from error


def _rounded(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {key: _rounded(value) for key, value in tree.items()}
    if isinstance(tree, list | tuple):
        return [_rounded(value) for value in tree]
    return float(f"{tree:.6g}") if isinstance(tree, float) else tree
