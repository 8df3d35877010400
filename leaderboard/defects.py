"""The audited defect of each table, and the map of symmetry's advantage against it.

The audit (docs/audit.md) measures in simulation how much of a task's symmetry is broken. Its
committed summary is read as data; nothing is simulated here.
"""

from __future__ import annotations

import hashlib
import re
from codecs import BOM_UTF8
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from symsteer.errors import UserError, first_problem
from symsteer.leaderboard.paper import STANDARD, USING_SYMMETRY
from symsteer.leaderboard.records import canonical_json
from symsteer.leaderboard.statistics import (
    RESAMPLES,
    Array,
    Estimate,
    Interval,
    Sample,
    cell_estimates,
    combined,
    crossed_bootstrap,
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
from symsteer.terminal import to_paste
from symsteer.variant import UNBROKEN, VariantSpec, parse_variant, variant_text

AUDIT = Path(__file__).resolve().parent / "results" / "audit" / "summary.json"
"""The audit of all tasks and variants that the repository and every wheel contain."""

SIGNIFICANT = 0.01
"""Resets differ from their turned copies below this p-value."""

MEASURES = ("auc", "success")
"""What the advantage is measured in: area under the curve, final-window success."""

CROSSING_GRID = 101
"""Defects at which the sign of a fitted advantage is asked for."""

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
class Defect:
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


Audit = Mapping[Place, Defect]


def read_audit(path: Path | None = None) -> Audit:
    """Defects by place from the audit's summary, `AUDIT` by default.

    Raises UserError for a path that cannot be read or holds something else.
    """
    path = path or AUDIT
    try:
        return parse_audit(path.read_bytes(), path)
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}.") from error


def parse_audit(data: bytes, path: Path) -> dict[Place, Defect]:
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
    audit: dict[Place, Defect] = {}
    for cell in cells:
        place = cell.task, cell.embodiment, in_order(cell.variant), cell.group
        if place in audit:
            raise UserError(
                f"{path} holds {' '.join(place)} twice: remove the older of the two cells."
            )
        differ = cell.resets_p < SIGNIFICANT
        audit[place] = Defect(Interval(*cell.decision), cell.part, Interval(*cell.resets), differ)
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


def defect_of(key: Key, audit: Audit) -> Defect | None:
    """The audited defect of a table's task, embodiment, variant and group; None if not audited."""
    return audit.get((key.task, key.embodiment, in_order(key.variant), key.group))


def audit_commands(keys: Sequence[Key]) -> list[str]:
    """Commands that measure the defects of tables, one for each task, embodiment and group.

    Names that no task or variant could have are left out: text from a record must not become part
    of a command that a reader copies.
    """
    wanted: dict[tuple[str, str, str], dict[str, None]] = {}
    for key in sorted(keys):
        words = (key.task, key.embodiment, key.variant, key.group)
        constant = all(spec.is_constant for spec in parts_of(key.variant) or ())
        if constant and all(re.fullmatch(r"[A-Za-z0-9][\w.:+-]*", w, re.ASCII) for w in words):
            wanted.setdefault((key.task, key.embodiment, key.group), {})[key.variant] = None
    return [
        to_paste(
            *("symsteer", "audit", "--task", task, "--embodiment", embodiment, "--group", group),
            *("--variant", *variants, "--out", "runs/audit"),
        )
        for (task, embodiment, group), variants in wanted.items()
    ]


@dataclass(frozen=True)
class Point:
    """One table with its defect: the differences of two agents by pair of runs."""

    table: Table
    defect: Defect
    pairs: Mapping[Pair, Sample]

    @cached_property
    def advantage(self) -> Interval:
        """Mean of the differences."""
        return crossed_bootstrap(list(self.pairs.values()))

    @property
    def counts(self) -> bool:
        """Whether it has the runs that a verdict needs."""
        return len(self.pairs) >= MIN_SEEDS

    @property
    def policies(self) -> int:
        """How many base policies it has pairs on."""
        return len({policy for policy, _ in self.pairs})

    @property
    def dial(self) -> str:
        """The variant without its strength; `none` for the unbroken control."""
        return dial_of(self.table.key.variant)

    @property
    def setting(self) -> Key:
        """What the points have in common between which base policies can be compared."""
        return replace(self.table.key, breaking=(False, UNBROKEN))


@dataclass(frozen=True)
class Line:
    """The fit to one setting's points: through `centre` (defect, advantage), over `span`."""

    setting: Key
    centre: tuple[float, float]
    span: tuple[float, float]


@dataclass(frozen=True)
class Crossing:
    """The defect at which a fitted advantage is 0, in the range of the fit.

    Attributes:
        value: None if the line does not cross 0 in the range.
        low, high: the advantage may be 0 between them (95 %); None at an end of the range.
        before, after: sign of the advantage at the ends of the range, 0 if undecided.
    """

    value: float | None
    low: float | None
    high: float | None
    before: int
    after: int


@dataclass(frozen=True)
class Fit:
    """Least squares with an intercept for each base policy, so that only the dials move it.

    Attributes:
        slope: change of the advantage per 1 of defect.
        policies: base policies that were steered at two defects or more.
        lines: the mean over the policies of each setting.
        level: advantage at the mean defect `centre`.
    """

    slope: Estimate
    policies: int
    lines: tuple[Line, ...]
    level: Estimate
    centre: float

    @property
    def settings(self) -> set[Key]:
        """The settings whose points it is about."""
        return {line.setting for line in self.lines}

    def at(self, defect: float) -> Interval:
        """The advantage on the fitted line."""
        return combined([self.level, self.slope], [1, defect - self.centre]).interval()

    def crossing(self) -> Crossing:
        """Where the line crosses 0: by Fieller's method, the defects at which 0 is not excluded."""
        ends = [end for line in self.lines for end in line.span]
        grid = np.linspace(min(ends), max(ends), CROSSING_GRID)
        signs = np.array([self.at(float(x)).sign for x in grid])
        zero = self.centre - self.level.value / self.slope.value if self.slope.value else np.inf
        undecided = grid[signs == 0]
        return Crossing(
            float(zero) if grid[0] <= zero <= grid[-1] else None,
            float(undecided[0]) if len(undecided) and signs[0] else None,
            float(undecided[-1]) if len(undecided) and signs[-1] else None,
            int(signs[0]),
            int(signs[-1]),
        )

    @property
    def reason(self) -> str:
        """Why the slope decides nothing, whatever its interval; empty if it may."""
        if self.policies >= MIN_SEEDS:
            return ""
        return f"base policies at several defects: {self.policies}, {MIN_SEEDS} are needed"


@dataclass(frozen=True)
class Panel:
    """The advantage of one agent in one measure against the defect, in one embodiment.

    Attributes:
        fit: over all dials; None if no base policy was steered at two defects.
        dials: fits to the unbroken control and one dial, by its name.
    """

    embodiment: str
    agent: str
    measure: str
    points: tuple[Point, ...] = ()
    fit: Fit | None = None
    dials: Mapping[str, Fit] = field(default_factory=dict)

    @property
    def slope(self) -> Estimate | None:
        """Change of the advantage per 1 of defect, within base policies."""
        return self.fit.slope if self.fit else None

    @property
    def reason(self) -> str:
        """Why the slope decides nothing, whatever its interval; empty if it may."""
        return self.fit.reason if self.fit else "no base policy was steered at two audited defects"


@dataclass(frozen=True)
class DefectMap:
    """All panels, by (embodiment, agent, measure), and the tables that are not audited.

    Arm and gripper have panels of their own: a defect of 0.3 of the unbroken arm is its
    kinematics, one of 0.3 of the gripper a dial.
    """

    panels: Mapping[tuple[str, str, str], Panel]
    unaudited: tuple[Key, ...]

    @property
    def embodiments(self) -> list[str]:
        """Those that have points."""
        return sorted({e for (e, _, _), panel in self.panels.items() if panel.points})

    def agents(self, embodiment: str) -> list[str]:
        """Those of `USING_SYMMETRY` that have points."""
        agents = {a for (e, a, _), panel in self.panels.items() if e == embodiment and panel.points}
        return [agent for agent in USING_SYMMETRY if agent in agents]

    def panel(self, embodiment: str, agent: str, measure: str) -> Panel:
        """A panel, without points if there are none."""
        empty = Panel(embodiment, agent, measure)
        return self.panels.get((embodiment, agent, measure), empty)


def defect_map(summary: Summary, audit: Audit) -> DefectMap:
    """Advantage of `USING_SYMMETRY` over `STANDARD` in audited tables, with slopes."""
    panels = {}
    for embodiment in sorted({table.key.embodiment for table in summary.tables}):
        for agent in USING_SYMMETRY:
            for measure in MEASURES:
                points = points_of(summary, audit, embodiment, agent, measure)
                fits = {
                    dial: found
                    for dial in sorted({point.dial for point in points} - {UNBROKEN})
                    if (found := fit([p for p in points if p.dial in (dial, UNBROKEN)]))
                }
                panels[embodiment, agent, measure] = Panel(
                    embodiment, agent, measure, tuple(points), fit(points), fits
                )
    unaudited = [table.key for table in summary.tables if not defect_of(table.key, audit)]
    return DefectMap(panels, tuple(unaudited))


def points_of(
    summary: Summary, audit: Audit, embodiment: str, agent: str, measure: str
) -> list[Point]:
    """The audited tables of an embodiment with paired runs of an agent and of `STANDARD`.

    Only those with the usual budget and number of demonstrations (`Summary.usual_tables`).
    """
    points = []
    for table in summary.usual_tables:
        defect = defect_of(table.key, audit)
        if defect is None or table.key.embodiment != embodiment:
            continue
        if pairs := advantage(table, agent, STANDARD, measure):
            points.append(Point(table, defect, pairs))
    return points


def advantage(table: Table, first: str, second: str, measure: str) -> dict[Pair, Sample]:
    """Paired differences of two agents in a table; empty if one of them is missing."""
    rows = table.row_of(first), table.row_of(second)
    if rows[0] is None or rows[1] is None:
        return {}
    if measure == "auc":
        return area_pairs(rows[0], rows[1], table.key.env_steps)
    return success_pairs(rows[0], rows[1])


def fit(points: Sequence[Point], resamples: int = RESAMPLES, seed: int = 0) -> Fit | None:
    """The slope within base policies; None where none was steered at two different defects.

    Every base policy (where a setting has one only, every run) has an intercept of its own, so what
    policies or tasks differ in by themselves does not enter. Resamples draw policies and episodes
    (`cell_estimates`), and each defect within its interval. The points themselves are not drawn.
    """
    defects = np.array([point.defect.value for point in points])
    settings = steered(points, defects=2)
    every = [unit for units in settings.values() for unit in units]
    if not every:
        return None
    total = sum(float((_centred(defects[list(unit)]) ** 2).sum()) for unit in every)
    cells = [
        [_weighted(unit, _centred(defects[list(unit)])) for unit in units]
        for units in settings.values()
    ]
    estimates = cell_estimates(cells, resamples=resamples)
    slope = combined(estimates, [len(units) / total for units in settings.values()])
    drawn = drawn_defects(points, resamples, seed)
    rise, run = np.zeros(resamples), np.zeros(resamples)
    for unit in every:
        x = _centred(drawn[list(unit)])
        rise += (x * np.array([[sample.value] for sample in unit.values()])).sum(axis=0)
        run += (x**2).sum(axis=0)
    moved = np.divide(rise, run, out=np.full(resamples, slope.value), where=run > 0)
    lines = []
    for setting, units in settings.items():
        x = np.concatenate([defects[list(unit)] for unit in units])
        y = [sample.value for unit in units for sample in unit.values()]
        centre = float(x.mean()), float(np.mean(y))
        lines.append(Line(setting, centre, (float(x.min()), float(x.max()))))
    means = [[Sample.mean(list(unit.values())) for unit in units] for units in settings.values()]
    shares = [len(units) / len(every) for units in settings.values()]
    return Fit(
        level=combined(cell_estimates(means, resamples=resamples), shares),
        centre=float(np.mean([defects[list(unit)].mean() for unit in every])),
        slope=replace(slope, episodes=slope.episodes + moved - slope.value),
        policies=len({sample.policy for unit in every for sample in unit.values()}),
        lines=tuple(lines),
    )


Unit = dict[int, Sample]
"""What a base policy has at each point, by the point's index."""


def steered(points: Sequence[Point], defects: int = 1) -> dict[Key, list[Unit]]:
    """The base policies of each setting that were steered at so many different defects."""
    found: dict[Key, list[Unit]] = {}
    for setting in sorted({point.setting for point in points}):
        here = {i: point for i, point in enumerate(points) if point.setting == setting}
        units = [
            unit for unit in _units(here) if len({here[i].defect.value for i in unit}) >= defects
        ]
        if units:
            found[setting] = units
    return found


def drawn_defects(points: Sequence[Point], resamples: int, seed: int = 0) -> Array:
    """Each point's defect within its interval: [points, resamples]."""
    generator = np.random.default_rng(seed)
    return np.stack([point.defect.draw(resamples, generator) for point in points])


def _units(points: Mapping[int, Point]) -> list[Unit]:
    """What each base policy has at each point of a setting; each run if there is one policy."""
    alone = len({policy for point in points.values() for policy, _ in point.pairs}) == 1
    found: dict[Pair, dict[int, list[Sample]]] = defaultdict(lambda: defaultdict(list))
    for index, point in points.items():
        for (policy, seed), sample in point.pairs.items():
            found[policy, seed if alone else 0][index].append(sample)
    return [
        {index: Sample.mean(samples) for index, samples in found[unit].items()}
        for unit in sorted(found)
    ]


def _centred(values: Array) -> Array:
    """Less the mean along the first axis."""
    return values - values.mean(axis=0)


def _weighted(unit: Unit, factors: Array) -> Sample:
    """The sum of samples of one base policy, each times its factor."""
    samples = list(unit.values())
    blocks = tuple(block for sample in samples for block in sample.blocks)
    weights = tuple(
        float(f) * w for f, sample in zip(factors, samples, strict=True) for w in sample.weights
    )
    return Sample(blocks, weights, samples[0].policy)
