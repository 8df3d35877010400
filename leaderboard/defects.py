"""The audited defect of each table: how differently the world answers to turned decisions.

The audit (docs/audit.md) measures in simulation how much of a task's symmetry is broken. Its
committed summary is read as data; nothing is simulated here.
"""

from __future__ import annotations

import hashlib
from codecs import BOM_UTF8
from collections.abc import Mapping
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from symsteer.errors import UserError, first_problem
from symsteer.leaderboard.keys import Key
from symsteer.leaderboard.records import canonical_json
from symsteer.leaderboard.statistics import Array, Interval
from symsteer.variant import VariantSpec, parse_variant, variant_text

AUDIT = Path(__file__).resolve().parent / "results" / "audit" / "summary.json"
"""The audit of all tasks and variants that the repository and every wheel contain."""

SIGNIFICANT = 0.01
"""Resets differ from their turned copies below this p-value."""

NORMAL = 1.96
"""Half the width of a 95 % interval in standard deviations."""

Place = tuple[str, str, str, str]
"""Task, embodiment, variant in canonical form, group of the base policy."""

Part = Literal["tool", "object", "cost", "observation"]
"""What the defect of a decision is a defect of."""

Number = Annotated[float, Field(allow_inf_nan=False)]


class _AuditCell(BaseModel):
    model_config = ConfigDict(extra="ignore", strict=True, frozen=True)
    version: Literal[2]
    task: str
    embodiment: str
    variant: str
    group: str
    part: Part
    decision: tuple[Number, Number, Number]
    resets: tuple[Number, Number, Number]
    resets_p: Number

    @model_validator(mode="after")
    def _ordered(self) -> _AuditCell:
        value, low, high = self.decision
        if not low <= value <= high:
            raise ValueError("decision lies outside of its interval")
        return self


_CELLS = TypeAdapter(list[_AuditCell])

ALIKE = Interval(0.0, 0.0, 0.0)
"""The distance of equal distributions."""


@dataclass(frozen=True)
class AuditedDefect:
    """The audited defect of a decision in a cell, and of which part of the decision it is.

    Beside it `resets`, the energy distance of initial states from their turned copies, and whether
    these differ. They are no part of a decision.
    """

    interval: Interval
    part: Part
    resets: Interval = ALIKE
    resets_differ: bool = False

    @property
    def value(self) -> float:
        return self.interval.value

    def draw(self, size: int, generator: np.random.Generator) -> Array:
        """Values within the interval: normal, with a standard deviation of its own on each side."""
        normal = generator.standard_normal(size)
        up = (self.interval.high - self.value) / NORMAL
        down = (self.value - self.interval.low) / NORMAL
        return np.maximum(0.0, self.value + normal * np.where(normal > 0, up, down))


Audit = Mapping[Place, AuditedDefect]


def read_audit(path: Path | None = None) -> Audit:
    """Defects by place from an audit's folder or summary, `AUDIT` by default.

    Raises UserError for a path that cannot be read or holds something else.
    """
    path = path or AUDIT
    path = path / AUDIT.name if path.is_dir() else path
    try:
        return parse_audit(path.read_bytes(), path)
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}.") from error


def parse_audit(data: bytes, path: Path) -> dict[Place, AuditedDefect]:
    """`read_audit` of a file's content; `path` is for messages."""
    try:
        cells = _CELLS.validate_json(data.removeprefix(BOM_UTF8))
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        if first["loc"][1:] == ("version",):
            raise UserError(
                f"{path} holds an audit of another version of SymSteer, without the defects of "
                "decisions: measure it again with `symsteer audit`."
            ) from error
        raise UserError(
            f"{path} is no summary of an audit ({first_problem(error)}): "
            "name the summary.json that `symsteer audit --out` wrote."
        ) from error
    audit: dict[Place, AuditedDefect] = {}
    for cell in cells:
        place = cell.task, cell.embodiment, in_order(cell.variant), cell.group
        if place in audit:
            raise UserError(
                f"{path} holds {' '.join(place)} twice: remove the older of the two cells."
            )
        differ = cell.resets_p < SIGNIFICANT
        audit[place] = AuditedDefect(
            Interval(*cell.decision), cell.part, Interval(*cell.resets), differ
        )
    return audit


def fingerprint(audit: Audit) -> str:
    """How many cells an audit has, and a hash of their defects."""
    defects = [[*place, *astuple(defect)] for place, defect in sorted(audit.items())]
    digest = hashlib.sha256(canonical_json(defects).encode()).hexdigest()
    return f"{len(audit)} cells, {digest[:12]}"


def in_order(variant: str) -> str:
    """One spelling for one variant, its parts in alphabetical order; other texts as they are."""
    specs = sorted(parts_of(variant) or (), key=lambda spec: spec.text)
    return variant_text(specs) if specs else variant


def parts_of(variant: str) -> tuple[VariantSpec, ...] | None:
    """The parts of a variant in canonical form; None for other texts, which a record may have."""
    try:
        return parse_variant(variant)
    except UserError:
        return None


def dial_of(variant: str) -> str:
    """A variant without strengths, its parts in alphabetical order; other texts as they are."""
    names = sorted(spec.name for spec in parts_of(variant) or ())
    return "+".join(names) or variant


def defect_of(key: Key, audit: Audit) -> AuditedDefect | None:
    """The audited defect of a table's task, embodiment, variant and group; None if not audited."""
    return audit.get((key.task, key.embodiment, in_order(key.variant), key.group))
