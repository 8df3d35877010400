"""The audited defect, the map, and the place where the advantage of symmetry ends."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from symsteer.errors import UserError
from symsteer.leaderboard.defects import (
    AUDIT,
    Audit,
    Defect,
    Line,
    Panel,
    Point,
    audit_commands,
    crossing,
    defect_map,
    fit,
    read_audit,
)
from symsteer.leaderboard.page import crossing_text
from symsteer.leaderboard.statistics import Interval, Sample
from symsteer.leaderboard.summary import Run, Summary, Table, summarize
from tests.leaderboard.record_factory import make_cell

CELL = {
    "task": "PickCube-v1",
    "embodiment": "floating",
    "variant": "action_gain:0.50",
    "group": "C8",
    "tool_step": [0.1, 0.08, 0.12],
    "cost": [0.0, 0.0, 0.0],
    "observation": [0.2, 0.15, 0.3],
    "dense": [1.0, 1.0, 1.0],
}
VARIANTS = ("none", "action_gain:0.25", "action_gain:0.5", "action_gain:1", "wind:1")


def write(folder: Path, data: object) -> Path:
    path = folder / "summary.json"
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return path


def test_the_largest_component_is_the_defect(tmp_path: Path) -> None:
    audit = read_audit(write(tmp_path, [CELL, CELL | {"variant": "none", "cost": [0.3, 0.3, 0.3]}]))
    place = "PickCube-v1", "floating", "action_gain:0.5", "C8"
    assert audit[place] == Defect(Interval(0.2, 0.15, 0.3), "observation")
    assert audit[(*place[:2], "none", "C8")].component == "cost"


def test_the_committed_audit_can_be_read() -> None:
    audit = read_audit()
    assert len(audit) == len(json.loads(AUDIT.read_text()))
    place = "PickCube-v1", "floating"
    unbroken, broken = audit[(*place, "none", "C8")], audit[(*place, "action_gain:1", "C8")]
    assert 0 < unbroken.value < 0.01 < 0.1 < broken.value < 0.4
    assert broken.component == "tool_step"


def bad(**changes: Any) -> list[Any]:
    return [CELL, CELL | changes]


@pytest.mark.parametrize(
    "data",
    [
        "",
        json.dumps([CELL])[:-9],
        "{}",
        "3",
        "[3]",
        "[" * 100_000,
        [{"task": "PickCube-v1"}],
        bad(task=3),
        bad(tool_step=[0.1, 0.2]),
        bad(tool_step=[0.1, 0.2, "0.3"]),
        bad(tool_step=[0.1, 0.2, 0.3]),
        bad(cost=None),
        json.dumps([CELL]).replace("0.12", "NaN"),
        json.dumps([CELL]).replace("0.12", "1e999"),
    ],
)
def test_a_bad_audit_is_one_sentence(tmp_path: Path, data: object) -> None:
    with pytest.raises(UserError, match=r"summary\.json is no summary of an audit") as error:
        read_audit(write(tmp_path, data))
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 500


def test_a_cell_is_audited_once(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"holds PickCube-v1 .* twice: remove the older"):
        read_audit(write(tmp_path, [CELL, CELL | {"tool_step": [0.2, 0.1, 0.3]}]))


def test_a_missing_audit_is_an_error(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"cannot be read"):
        read_audit(tmp_path / "nowhere.json")
    with pytest.raises(UserError, match=r"cannot be read"):
        read_audit(tmp_path)


def test_the_order_of_variants_does_not_matter(tmp_path: Path) -> None:
    audit = read_audit(write(tmp_path, [CELL | {"variant": "wind:0.50+obstacle:1.0"}]))
    assert list(audit) == [("PickCube-v1", "floating", "obstacle:1+wind:0.5", "C8")]
    # A text that is no variant stands for itself.
    audit = read_audit(write(tmp_path, [CELL | {"variant": "wind:<b>"}]))
    assert [place[2] for place in audit] == ["wind:<b>"]


def test_defects_are_drawn_within_their_interval() -> None:
    defect = Defect(Interval(0.1, 0.08, 0.16), "tool_step")
    draws = defect.draw(100_000, np.random.default_rng(0))
    assert np.quantile(draws, (0.025, 0.5, 0.975)) == pytest.approx((0.08, 0.1, 0.16), abs=1e-3)
    near_zero = Defect(Interval(0.001, -0.01, 0.01), "cost").draw(1000, np.random.default_rng(0))
    assert near_zero.min() == 0


# The line


def cells(rates: dict[str, tuple[float, float, float]], seeds: int = 5) -> Summary:
    """One table for each variant, from (standard, equivariant, approximate)."""
    records = [
        record
        for variant, (standard, equivariant, approximate) in rates.items()
        for record in make_cell(
            {"standard": standard, "equivariant": equivariant, "approximate": approximate},
            seeds,
            variant=variant,
        )
    ]
    return summarize([Run(Path(f"{r.run_id}.json"), r) for r in records])


def audit_of(defects: dict[str, float], width: float = 0.0) -> Audit:
    return {
        ("PickCube-v1", "floating", variant, "C8"): Defect(
            Interval(value, value - width, value + width), "tool_step"
        )
        for variant, value in defects.items()
    }


def test_the_map_pairs_and_places_every_audited_cell() -> None:
    summary = cells({"none": (0.5, 0.9, 0.8), "wind:1": (0.5, 0.3, 0.5), "obstacle:1": (0, 1, 1)})
    found = defect_map(summary, audit_of({"none": 0.01, "wind:1": 0.3}))
    points = found.panels["equivariant", "success"].points
    assert [point.defect.value for point in points] == [0.01, 0.3]
    assert [point.advantage.value for point in points] == pytest.approx([0.4, -0.2])
    approximate = found.panels["approximate", "auc"].points
    assert [point.advantage.value for point in approximate] == pytest.approx([0.3, 0.0])
    assert [key.variant for key in found.unaudited] == ["obstacle:1"]
    assert all(panel.line is None for panel in found.panels.values())
    assert "fewer than 3 different defects" in crossing_text(found.panels["equivariant", "auc"])


def test_the_area_is_measured_along_the_whole_curve() -> None:
    records = make_cell({"standard": (0.0, 0.5, 0.5), "equivariant": (0.0, 1.0, 0.5)})
    summary = summarize([Run(Path(f"{r.run_id}.json"), r) for r in records])
    found = defect_map(summary, audit_of({"none": 0.0}))
    assert found.panels["equivariant", "auc"].points[0].advantage.value == pytest.approx(0.25)
    assert found.panels["equivariant", "success"].points[0].advantage.value == pytest.approx(0.0)


def test_a_crossing_is_recovered() -> None:
    """0.3 - 1 x defect falls through zero at 0.3; five seeds, 40 episodes."""
    defects = dict(zip(VARIANTS, (0.0, 0.1, 0.2, 0.4, 0.5), strict=True))
    rates = {v: (0.5, 0.5 + 0.3 - d, 0.5 + 0.3) for v, d in defects.items()}
    found = defect_map(cells(rates), audit_of(defects, width=0.02))
    for measure in ("auc", "success"):
        line = found.panels["equivariant", measure].line
        assert line is not None
        assert line.slope.value == pytest.approx(-1, abs=0.02)
        assert line.slope.sign == -1
        assert line.intercept == pytest.approx(0.3, abs=0.01)
        assert line.crossing.value == pytest.approx(0.3, abs=0.01)
        assert 0.19 < line.crossing.low < 0.3 < line.crossing.high < 0.42
        flat = found.panels["approximate", measure].line
        assert flat is not None
        assert flat.slope.sign == 0
        assert (flat.crossing.value, flat.crossing.low) == (None, np.inf)
    text = crossing_text(found.panels["approximate", "auc"])
    assert text == (
        "none: the line stays above 0 from 0.00 to 0.50; at 95 % there is none in this range"
    )
    assert crossing_text(found.panels["equivariant", "auc"]).startswith("0.30 [0.2")


def test_cells_with_few_seeds_are_shown_and_do_not_enter_the_line() -> None:
    rates = dict.fromkeys(VARIANTS, (0.5, 0.6, 0.5))
    defects = {v: 0.1 * i for i, v in enumerate(VARIANTS)}
    found = defect_map(cells(rates, seeds=4), audit_of(defects))
    panel = found.panels["equivariant", "success"]
    assert len(panel.points) == 5
    assert not any(point.counts for point in panel.points)
    assert panel.line is None


def synthetic(generator: np.random.Generator, scatter: float, table: Table) -> list[Point]:
    """Eight cells about 0.2 - 0.8 x defect; their audits are off by as much as they say."""
    points = []
    for truth in np.linspace(0.0, 0.5, 8):
        measured = float(abs(truth + generator.normal(0, 0.01)))
        defect = Defect(Interval(measured, measured - 0.02, measured + 0.02), "tool_step")
        mean = 0.2 - 0.8 * truth + generator.normal(0, scatter)
        rates = mean + generator.normal(0, 0.05, size=5)
        samples = tuple(
            Sample.pooled(enumerate(rate + generator.normal(0, 0.6, size=60))) for rate in rates
        )
        value = float(np.mean([sample.value for sample in samples]))
        points.append(Point(table, defect, samples, Interval(value, value, value)))
    return points


@pytest.mark.parametrize("scatter", [0.0, 0.08])
def test_the_interval_covers_the_true_crossing(scatter: float) -> None:
    """Also where cells scatter about the line by more than their seeds explain."""
    table = cells({"none": (0.5, 0.6, 0.5)}).tables[0]
    generator = np.random.default_rng(5)
    covered, widths = 0, []
    for trial in range(60):
        line = fit(synthetic(generator, scatter, table), resamples=300, seed=trial)
        assert line is not None
        covered += line.crossing.low <= 0.25 <= line.crossing.high
        widths.append(line.crossing.high - line.crossing.low)
    assert covered >= 54
    assert np.median(widths) < (0.2 if scatter == 0 else 0.4)


def test_crossings_by_hand() -> None:
    """20 resamples of lines over 0 to 1: intercept 1, slopes that cross early, late or never."""

    def of(slopes: list[float], intercepts: list[float]) -> tuple[float, float]:
        found = crossing(-2.0, 1.0, np.array(slopes), np.array(intercepts), (0.0, 1.0))
        assert found.value == 0.5
        return found.low, found.high

    inside = [-2.0] * 18
    assert of([*inside, -4.0, -1.25], [1.0] * 20) == (0.25, 0.8)
    # One resample without a crossing in the range opens the interval on its side.
    assert of([*inside, -4.0, -0.5], [1.0] * 20) == (0.25, np.inf)
    assert of([*inside, -1.0, -1.25], [1.0] * 18 + [-0.5, 1.0]) == (-np.inf, 0.8)
    # A line that rises through zero is no evidence for any end.
    assert of([*inside, -2.0, 1.0], [1.0] * 19 + [-0.5]) == (-np.inf, np.inf)


def test_no_crossing_is_said_in_words() -> None:
    nothing = np.zeros(2)

    def text(slope: float, intercept: float, slopes: list[float], intercepts: list[float]) -> str:
        found = crossing(slope, intercept, np.array(slopes), np.array(intercepts), (0.0, 0.4))
        interval = Interval(slope, slope, slope)
        line = Line(intercept, interval, (0.0, 0.4), nothing, nothing, nothing, found)
        return crossing_text(Panel("equivariant", "auc", (), line))

    assert text(-1, 0.5, [-1.0] * 20, [0.5] * 20) == (
        "none: the line stays above 0 from 0.00 to 0.40; at 95 % there is none in this range"
    )
    assert text(-1, -0.1, [-1.0] * 20, [-0.1] * 20).startswith("none: the line stays below 0 from")
    assert text(1, -0.1, [1.0] * 20, [-0.1] * 20) == (
        "none: the line rises through 0 from 0.00 to 0.40; the data do not say where"
    )
    assert text(-1, 0.5, [-1.0] * 19 + [-2.0], [0.5] * 20).endswith("it does not lie below 0.25")
    assert text(-1, -0.1, [-1.0] * 20, [-0.1] * 19 + [0.3]).endswith("does not lie beyond 0.30")
    assert text(-1, 0.2, [-1.0] * 20, [0.2] * 19 + [0.5]) == "0.20 [0.20, beyond all audited]"
    assert text(-1, 0.2, [-1.0] * 20, [0.2] * 19 + [-1]) == "0.20 [below all audited, 0.20]"


# What is missing


def test_commands_name_what_has_to_be_measured() -> None:
    summary = cells({"none": (0.5, 0.6, 0.5), "wind:1": (0.5, 0.6, 0.5)})
    keys = [table.key for table in summary.tables]
    assert audit_commands(keys) == [
        "symsteer audit --task PickCube-v1 --embodiment floating --group C8 "
        "--variant none wind:1 --out runs/audit"
    ]


@pytest.mark.parametrize("text", ["a; rm -rf b", "$(x)", "`x`", "a b", "-rf", "a\nb", "x'"])
def test_a_hostile_name_becomes_no_command(text: str) -> None:
    summary = cells({text: (0.5, 0.6, 0.5)})
    assert audit_commands([table.key for table in summary.tables]) == []
