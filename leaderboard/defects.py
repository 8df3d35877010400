"""The audited defect of each table, and the map of symmetry's advantage against it.

The audit (docs/audit.md) measures in simulation how much of a task's symmetry is broken. Its
committed summary is read as data; nothing is simulated here.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from symsteer.errors import UserError
from symsteer.leaderboard.paper import STANDARD, WITH_SYMMETRY
from symsteer.leaderboard.records import canonical_json
from symsteer.leaderboard.statistics import (
    RESAMPLES,
    Array,
    Interval,
    Sample,
    crossed_bootstrap,
    percentile,
    stratified_draws,
)
from symsteer.leaderboard.summary import (
    MIN_SEEDS,
    Key,
    Pair,
    Summary,
    Table,
    area_pairs,
    success_pairs,
)
from symsteer.variant import parse_variant, variant_text

AUDIT = Path(__file__).resolve().parent / "results" / "audit" / "summary.json"
"""The audit of all tasks and variants that the repository and every wheel contain."""

COMPONENTS = {"tool_step": "dynamics", "cost": "reward", "observation": "observation"}
"""Columns of the audit, and what each is a defect of. The map's x is the largest of them."""

MEASURES = ("auc", "success")
"""What the advantage is measured in: area under the curve, final-window success."""

MIN_CELLS = 3
"""A line through fewer points than this says nothing about its own error."""

NORMAL = 1.96
"""Half the width of a 95 % interval in standard deviations."""

Place = tuple[str, str, str, str]
"""Task, embodiment, variant in canonical form, group of the base policy."""

Number = Annotated[float, Field(allow_inf_nan=False)]


class _AuditCell(BaseModel):
    model_config = ConfigDict(extra="ignore", strict=True, frozen=True)
    task: str
    embodiment: str
    variant: str
    group: str
    tool_step: tuple[Number, Number, Number]
    cost: tuple[Number, Number, Number]
    observation: tuple[Number, Number, Number]

    @model_validator(mode="after")
    def _ordered(self) -> _AuditCell:
        for name in COMPONENTS:
            value, low, high = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f"{name} lies outside of its interval")
        return self


_CELLS = TypeAdapter(list[_AuditCell])


@dataclass(frozen=True)
class Defect:
    """The largest audited defect of a cell, and which component it is (`COMPONENTS`)."""

    interval: Interval
    component: str

    @property
    def value(self) -> float:
        return self.interval.value

    def draw(self, size: int, generator: np.random.Generator) -> Array:
        """Values within the interval: normal, with a standard deviation of its own on each side."""
        normal = generator.standard_normal(size)
        up = (self.interval.high - self.value) / NORMAL
        down = (self.value - self.interval.low) / NORMAL
        return np.maximum(0.0, self.value + normal * np.where(normal > 0, up, down))


Audit = Mapping[Place, Defect]


def read_audit(path: Path | None = None) -> Audit:
    """Defects by place from the audit's summary, `AUDIT` by default.

    Raises UserError for a path that cannot be read or holds something else.
    """
    path = path or AUDIT
    try:
        data = json.loads(path.read_bytes())
        if not isinstance(data, list):
            raise TypeError("not a list")
        # JSON has no tuples, so strictness about them starts inside.
        cells = _CELLS.validate_python([_with_tuples(cell) for cell in data])
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}.") from error
    except (ValueError, TypeError, RecursionError) as error:
        problem = "it is not such a list"
        if isinstance(error, ValidationError):
            first = error.errors(include_url=False, include_input=False)[0]
            problem = f"{'.'.join(map(str, first['loc']))[:120]}: {first['msg']}"
        raise UserError(
            f"{path} is no summary of an audit ({problem}): "
            "name the summary.json that `symsteer audit --out` wrote."
        ) from error
    audit: dict[Place, Defect] = {}
    for cell in cells:
        place = cell.task, cell.embodiment, _in_order(cell.variant), cell.group
        if place in audit:
            raise UserError(
                f"{path} holds {' '.join(place)} twice: remove the older of the two cells."
            )
        audit[place] = _largest(cell)
    return audit


def fingerprint(audit: Audit) -> str:
    """How many cells an audit has, and a hash of their defects."""
    defects = [[*place, d.component, *astuple(d.interval)] for place, d in sorted(audit.items())]
    digest = hashlib.sha256(canonical_json(defects).encode()).hexdigest()
    return f"{len(audit)} cells, {digest[:12]}"


def _with_tuples(cell: Any) -> Any:
    if not isinstance(cell, dict):
        return cell
    return {k: tuple(v) if k in COMPONENTS and isinstance(v, list) else v for k, v in cell.items()}


def _largest(cell: _AuditCell) -> Defect:
    name = max(COMPONENTS, key=lambda component: getattr(cell, component)[0])
    return Defect(Interval(*getattr(cell, name)), name)


def _in_order(variant: str) -> str:
    """One spelling for one variant, its parts in alphabetical order; other texts as they are."""
    try:
        specs = parse_variant(variant)
    except UserError:
        return variant
    return variant_text(sorted(specs, key=lambda spec: spec.text))


def defect_of(key: Key, audit: Audit) -> Defect | None:
    """The audited defect of a table's task, embodiment, variant and group; None if not audited."""
    return audit.get((key.task, key.embodiment, _in_order(key.variant), key.group))


def audit_commands(keys: Sequence[Key]) -> list[str]:
    """Commands that measure the defects of tables, one for each task, embodiment and group.

    Names that no task or variant could have are left out: text from a record must not become part
    of a command that a reader copies.
    """
    wanted: dict[tuple[str, str, str], list[str]] = {}
    for key in sorted(keys):
        words = (key.task, key.embodiment, key.variant, key.group)
        if key.group and all(re.fullmatch(r"[A-Za-z0-9][\w.:+-]*", w, re.ASCII) for w in words):
            variants = wanted.setdefault((key.task, key.embodiment, key.group), [])
            if key.variant not in variants:
                variants.append(key.variant)
    return [
        f"symsteer audit --task {task} --embodiment {embodiment} --group {group} "
        f"--variant {' '.join(variants)} --out runs/audit"
        for (task, embodiment, group), variants in wanted.items()
    ]


@dataclass(frozen=True)
class Point:
    """One table in one panel of the map: the advantage over `STANDARD`, paired by run seed."""

    table: Table
    defect: Defect
    samples: tuple[Sample, ...]
    advantage: Interval

    @property
    def counts(self) -> bool:
        """Whether it has the seeds that a fit needs."""
        return len(self.samples) >= MIN_SEEDS


@dataclass(frozen=True)
class Crossing:
    """Where the fitted line falls through zero: symmetry helps below and hurts above.

    `value` is None where the fitted line does not fall through zero inside the audited range. An
    end of the interval is infinite where 2.5 % of the resamples or more have no crossing on that
    side of the range: the interval is open there.
    """

    value: float | None
    low: float
    high: float


@dataclass(frozen=True)
class Line:
    """Least squares through the points: advantage = `intercept` + `slope` x defect."""

    intercept: float
    slope: Interval
    span: tuple[float, float]
    """Smallest and largest audited defect of the points."""
    grid: Array
    low: Array
    high: Array
    """The pointwise 95 % band of the line at the defects `grid`."""
    crossing: Crossing


@dataclass(frozen=True)
class Panel:
    """The advantage of one agent in one measure against the defect."""

    agent: str
    measure: str
    points: tuple[Point, ...]
    line: Line | None


@dataclass(frozen=True)
class DefectMap:
    """All panels, by (agent, measure), and the tables that are not audited."""

    panels: Mapping[tuple[str, str], Panel]
    unaudited: tuple[Key, ...]

    @property
    def has_points(self) -> bool:
        return any(panel.points for panel in self.panels.values())


def defect_map(summary: Summary, audit: Audit) -> DefectMap:
    """Advantage of `WITH_SYMMETRY` over `STANDARD` in audited tables, with lines and crossings."""
    panels = {}
    for agent in WITH_SYMMETRY:
        for measure in MEASURES:
            points = []
            for table in summary.tables:
                defect = defect_of(table.key, audit)
                samples = tuple(advantage(table, agent, STANDARD, measure).values())
                if defect and samples:
                    points.append(Point(table, defect, samples, crossed_bootstrap(samples)))
            line = fit([point for point in points if point.counts])
            panels[agent, measure] = Panel(agent, measure, tuple(points), line)
    unaudited = [table.key for table in summary.tables if not defect_of(table.key, audit)]
    return DefectMap(panels, tuple(unaudited))


def advantage(table: Table, first: str, second: str, measure: str) -> dict[Pair, Sample]:
    """Paired differences of two agents in a table; empty if one of them is missing."""
    rows = table.row_of(first), table.row_of(second)
    if rows[0] is None or rows[1] is None:
        return {}
    if measure == "auc":
        return area_pairs(rows[0], rows[1], table.key.env_steps)
    return success_pairs(rows[0], rows[1])


def fit(points: Sequence[Point], resamples: int = RESAMPLES, seed: int = 0) -> Line | None:
    """A line through the points; None for fewer than `MIN_CELLS` different defects.

    Every point weighs the same. Each resample draws runs and episodes within each cell, each defect
    within its interval, and what else makes cells differ (`_scatter`), and fits again.
    """
    defects = np.array([point.defect.value for point in points])
    if len(set(defects.tolist())) < MIN_CELLS:
        return None
    generator = np.random.default_rng(seed)
    x = np.stack([point.defect.draw(resamples, generator) for point in points], axis=1)
    y = stratified_draws([point.samples for point in points], resamples).T
    values = np.array([point.advantage.value for point in points])
    slope, intercept = _least_squares(defects, values)
    expected = np.var(y - slope * x, axis=0).mean()
    residuals = values - intercept - slope * defects
    scatter = _scatter(residuals, float(expected), resamples, generator)
    y += scatter * generator.standard_normal(y.shape)
    slopes, intercepts = _least_squares(x, y)
    span = float(defects.min()), float(defects.max())
    grid = np.linspace(*span, 50)
    band = np.quantile(intercepts[:, None] + slopes[:, None] * grid, (0.025, 0.975), axis=0)
    return Line(
        intercept=float(intercept),
        slope=percentile(float(slope), slopes),
        span=span,
        grid=grid,
        low=band[0],
        high=band[1],
        crossing=crossing(float(slope), float(intercept), slopes, intercepts, span),
    )


def _scatter(
    residuals: Array, expected: float, resamples: int, generator: np.random.Generator
) -> Array:
    """Draws of the standard deviation between cells: [resamples, 1].

    Cells differ by more than seeds, episodes and audit explain (`expected`), because tasks differ.
    With few residuals their variance is uncertain, so it is drawn from its distribution (sum of
    squares over a chi-square draw); `expected` is subtracted. Without this the interval misses the
    crossing half of the time when cells scatter three times as much as their seeds explain.
    """
    freedom = len(residuals) - 2
    observed = (residuals**2).sum() / generator.chisquare(freedom, size=(resamples, 1))
    return np.sqrt(np.maximum(0.0, observed - expected))


def _least_squares(x: Array, y: Array) -> tuple[Array, Array]:
    """Slope and intercept along the last axis."""
    centred = x - x.mean(axis=-1, keepdims=True)
    slope = (centred * y).sum(axis=-1) / (centred**2).sum(axis=-1)
    return slope, y.mean(axis=-1) - slope * x.mean(axis=-1)


def crossing(
    slope: float, intercept: float, slopes: Array, intercepts: Array, span: tuple[float, float]
) -> Crossing:
    """Where the line falls through zero, with the interval of its resamples.

    A resample that is positive over the whole `span` counts as a crossing beyond the upper end, a
    negative one as a crossing beyond the lower end. One that rises through zero inside has no such
    crossing; it counts against both ends, which can only widen the interval.
    """
    low, high = span
    at_low, at_high = intercepts + slopes * low, intercepts + slopes * high
    with np.errstate(divide="ignore", invalid="ignore"):
        roots = -intercepts / slopes
    roots = np.where((at_low > 0) & (at_high > 0), np.inf, roots)
    roots = np.where((at_low <= 0) & (at_high <= 0), -np.inf, roots)
    rising = (at_low <= 0) & (at_high > 0)
    lowest = np.where(rising, -np.inf, roots)
    highest = np.where(rising, np.inf, roots)
    falls = intercept + slope * low > 0 >= intercept + slope * high
    # Quantiles without interpolation: there is no number between a root and infinity.
    return Crossing(
        -intercept / slope if falls else None,
        float(np.quantile(lowest, 0.025, method="lower")),
        float(np.quantile(highest, 0.975, method="higher")),
    )
