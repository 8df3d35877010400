"""The audited defect, the map, and how the advantage of symmetry changes with the defect."""

from __future__ import annotations

import hashlib
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from symsteer.errors import UserError
from symsteer.leaderboard.defects import (
    AUDIT,
    Audit,
    Defect,
    Point,
    audit_commands,
    defect_map,
    fit,
    read_audit,
)
from symsteer.leaderboard.findings import analyse
from symsteer.leaderboard.map_page import map_section
from symsteer.leaderboard.records import RunRecord
from symsteer.leaderboard.statistics import Interval, Sample
from symsteer.leaderboard.study import PAPER, read_study
from symsteer.leaderboard.summary import Run, Summary, Table, summarize
from tests.leaderboard.record_factory import make_cell

VARIANTS = ("none", "action_gain:0.25", "action_gain:0.5", "action_gain:1", "wind:1")
CELL = {
    "version": 2,
    "task": "PickCube-v1",
    "embodiment": "floating",
    "variant": "action_gain:0.50",
    "group": "C8",
    "part": "object",
    "decision": [0.2, 0.15, 0.3],
    "resets": [-0.001, 0.0, 0.002],
    "resets_p": 0.4,
    "tool": [1.0, 1.0, 1.0],
}


def write(folder: Path, data: object) -> Path:
    path = folder / "summary.json"
    path.write_text(data if isinstance(data, str) else json.dumps(data))
    return path


def test_a_cell_has_its_defect_its_part_and_its_resets(tmp_path: Path) -> None:
    differ = {"variant": "none", "part": "cost", "resets": [0.05, 0.04, 0.06], "resets_p": 0.001}
    audit = read_audit(write(tmp_path, [CELL, CELL | differ]))
    place = "PickCube-v1", "floating", "action_gain:0.5", "C8"
    assert audit[place] == Defect(
        Interval(0.2, 0.15, 0.3), "object", Interval(-0.001, 0.0, 0.002), False
    )
    other = audit[(*place[:2], "none", "C8")]
    assert (other.part, other.resets.value, other.resets_differ) == ("cost", 0.05, True)


def test_an_audit_of_another_version_is_refused(tmp_path: Path) -> None:
    old = {key: value for key, value in CELL.items() if key not in ("version", "decision", "part")}
    for rows in ([old], [CELL, CELL | {"version": 3}]):
        with pytest.raises(UserError, match=r"another version .* measure it again") as error:
            read_audit(write(tmp_path, rows))
        assert "\n" not in str(error.value)


def test_the_committed_audit_can_be_read() -> None:
    audit = read_audit()
    assert len(audit) == len(json.loads(AUDIT.read_text()))

    def of(task: str, variant: str, embodiment: str = "floating") -> Defect:
        return audit[task, embodiment, variant, "C8"]

    assert 0 < of("PickCube-v1", "none").value < 0.06
    # Horizontal motion by itself: lifting and pushing see the same break alike.
    for task in ("PickCube-v1", "PushCube-v1"):
        assert 0.45 < of(task, "action_gain:1").value < 0.65
        assert of(task, "perception_bias:1").part == "observation"
    # What one step of the tool cannot see.
    assert of("PushCube-v1", "wind:1").part == "object"
    assert of("PushCube-v1", "none").interval.high < of("PushCube-v1", "wind:1").interval.low
    assert of("PickCube-v1", "none", "panda").interval.low > 0.1


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
        [{"version": 2, "task": "PickCube-v1"}],
        bad(task=3),
        bad(decision=[0.1, 0.2]),
        bad(decision=[0.2, 0.1, "0.3"]),
        bad(decision=[0.1, 0.2, 0.3]),
        bad(decision=None),
        bad(part="arm"),
        bad(resets=[0.1]),
        json.dumps([CELL]).replace("0.15", "NaN"),
        json.dumps([CELL]).replace("0.15", "1e999"),
    ],
)
def test_a_bad_audit_is_one_sentence(tmp_path: Path, data: object) -> None:
    with pytest.raises(UserError, match=r"summary\.json is no summary of an audit") as error:
        read_audit(write(tmp_path, data))
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 500


def test_a_cell_is_audited_once(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"holds PickCube-v1 .* twice: remove the older"):
        read_audit(write(tmp_path, [CELL, CELL | {"decision": [0.2, 0.1, 0.3]}]))


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
    defect = Defect(Interval(0.1, 0.08, 0.16), "tool")
    draws = defect.draw(100_000, np.random.default_rng(0))
    assert np.quantile(draws, (0.025, 0.5, 0.975)) == pytest.approx((0.08, 0.1, 0.16), abs=1e-3)
    near_zero = Defect(Interval(0.001, -0.01, 0.01), "cost").draw(1000, np.random.default_rng(0))
    assert near_zero.min() == 0


# Slopes


def cells(
    rates: dict[str, tuple[float, float, float]], policies: int = 5, **config: Any
) -> list[RunRecord]:
    """One cell for each variant, from (standard, equivariant, approximate); a policy per seed."""
    records = [
        record
        for variant, (standard, equivariant, approximate) in rates.items()
        for record in make_cell(
            {"standard": standard, "equivariant": equivariant, "approximate": approximate},
            variant=variant,
            **config,
        )
    ]
    for record in records:
        which = f"{record.settings.task} {record.settings.seed % policies}"
        record.base_policy.content_hash = hashlib.sha256(which.encode()).hexdigest()
    return records


def summary_of(*groups: list[RunRecord]) -> Summary:
    records = [record for group in groups for record in group]
    return summarize([Run(Path(f"{i}.json"), record) for i, record in enumerate(records)])


def audit_of(
    defects: dict[str, float],
    width: float = 0.0,
    task: str = "PickCube-v1",
    embodiment: str = "floating",
) -> Audit:
    return {
        (task, embodiment, variant, "C8"): Defect(
            Interval(value, value - width, value + width), "tool"
        )
        for variant, value in defects.items()
    }


def test_the_map_pairs_and_places_every_audited_cell() -> None:
    summary = summary_of(
        cells({"none": (0.5, 0.9, 0.8), "wind:1": (0.5, 0.3, 0.5), "obstacle:1": (0, 1, 1)})
    )
    found = defect_map(summary, audit_of({"none": 0.01, "wind:1": 0.3}))
    points = found.panel("floating", "equivariant", "success").points
    assert [point.defect.value for point in points] == [0.01, 0.3]
    assert [point.advantage.value for point in points] == pytest.approx([0.4, -0.2])
    assert [point.dial for point in points] == ["none", "wind"]
    approximate = found.panel("floating", "approximate", "auc").points
    assert [point.advantage.value for point in approximate] == pytest.approx([0.3, 0.0])
    assert [key.variant for key in found.unaudited] == ["obstacle:1"]


def test_the_map_has_the_fair_rival() -> None:
    rates = {"standard": 0.5, "augmented": 0.7, "equivariant": 0.9}
    records = [*make_cell(rates), *make_cell(rates, variant="wind:1")]
    found = defect_map(summary_of(records), audit_of({"none": 0.0, "wind:1": 0.3}))
    assert found.agents("floating") == ["augmented", "equivariant"]
    points = found.panel("floating", "augmented", "success").points
    assert [point.advantage.value for point in points] == pytest.approx([0.2, 0.2])


def test_the_area_is_measured_along_the_whole_curve() -> None:
    records = make_cell({"standard": (0.0, 0.5, 0.5), "equivariant": (0.0, 1.0, 0.5)})
    found = defect_map(summary_of(records), audit_of({"none": 0.0}))
    values = {m: found.panel("floating", "equivariant", m).points[0] for m in ("auc", "success")}
    assert values["auc"].advantage.value == pytest.approx(0.25)
    assert values["success"].advantage.value == pytest.approx(0.0)


def test_the_map_has_cells_of_the_usual_budget_and_demonstrations() -> None:
    rates = {"standard": 0.5, "equivariant": 0.7}
    few = {"mode": "diverse", "count": 5, "seed": 0}
    records = [
        *make_cell(rates),
        *make_cell(rates, variant="wind:1"),
        *make_cell(rates, variant="wind:1", env_steps=500_000),
        *make_cell(rates, demonstrations=few),
    ]
    found = defect_map(summary_of(records), audit_of({"none": 0.0, "wind:1": 0.4}))
    points = found.panel("floating", "equivariant", "success").points
    assert {(p.table.key.env_steps, p.table.key.demonstrations) for p in points} == {(50_000, 50)}
    assert {p.table.key.variant for p in points} == {"none", "wind:1"}


def test_a_slope_is_recovered() -> None:
    """0.3 - 1 x defect, with five base policies."""
    defects = dict(zip(VARIANTS, (0.0, 0.1, 0.2, 0.4, 0.5), strict=True))
    rates = {v: (0.5, 0.5 + 0.3 - d, 0.5 + 0.3) for v, d in defects.items()}
    found = defect_map(summary_of(cells(rates)), audit_of(defects, width=0.02))
    for measure in ("auc", "success"):
        panel = found.panel("floating", "equivariant", measure)
        assert panel.slope is not None
        slope = panel.slope.interval()
        assert slope.value == pytest.approx(-1, abs=0.02)
        assert -1.3 < slope.low < -1 < slope.high < -0.7
        assert (panel.reason, panel.fit.policies) == ("", 5)
        (line,) = panel.fit.lines
        assert line.centre == pytest.approx((0.24, 0.06))
        assert line.span == (0.0, 0.5)
        ends = panel.fit.crossing()
        assert ends.value == pytest.approx(0.3, abs=0.01)
        assert 0.1 < ends.low < 0.3 < ends.high < 0.5
        assert (ends.before, ends.after) == (1, -1)
        flat = found.panel("floating", "approximate", measure).slope
        assert flat is not None
        assert flat.interval().sign == 0
        never = found.panel("floating", "approximate", measure).fit.crossing()
        assert (never.value, never.low, never.high) == (None, None, None)
        assert (never.before, never.after) == (1, 1)


def test_policies_and_tasks_have_levels_of_their_own() -> None:
    """Between two tasks the advantage falls by 0.4; along each one's dial not at all."""
    dial = {"none": (0.5, 0.9, 0.5), "action_gain:1": (0.5, 0.9, 0.5)}
    low = dict.fromkeys(dial, (0.5, 0.5, 0.5))
    summary = summary_of(cells(dial), cells(low, task="PushCube-v1"))
    audit = {
        **audit_of({"none": 0.0, "action_gain:1": 0.1}),
        **audit_of({"none": 0.4, "action_gain:1": 0.5}, task="PushCube-v1"),
    }
    panel = defect_map(summary, audit).panel("floating", "equivariant", "success")
    assert panel.slope is not None
    assert panel.slope.value == pytest.approx(0, abs=1e-9)
    assert panel.fit.policies == 10
    centres = np.array(sorted(line.centre for line in panel.fit.lines))
    assert centres == pytest.approx(np.array([[0.05, 0.4], [0.45, 0.0]]))


def test_arm_and_gripper_are_apart() -> None:
    dial = {"none": (0.5, 0.9, 0.5), "action_gain:1": (0.5, 0.8, 0.5)}
    arm = {"none": (0.5, 0.6, 0.5), "action_gain:1": (0.5, 0.7, 0.5)}
    summary = summary_of(cells(dial), cells(arm, embodiment="panda"))
    defects = {"none": 0.0, "action_gain:1": 0.5}
    found = defect_map(summary, {**audit_of(defects), **audit_of(defects, embodiment="panda")})
    assert found.embodiments == ["floating", "panda"]
    for embodiment, slope in (("floating", -0.2), ("panda", 0.2)):
        panel = found.panel(embodiment, "equivariant", "success")
        assert {p.table.key.embodiment for p in panel.points} == {embodiment}
        assert panel.slope is not None
        assert panel.slope.value == pytest.approx(slope)
    nothing = found.panel("hand", "equivariant", "success")
    assert (nothing.slope, nothing.points) == (None, ())
    assert nothing.reason


def test_a_policy_that_is_not_in_all_cells_does_not_tilt_the_line() -> None:
    dial = {"none": (0.5, 0.6, 0.5), "action_gain:1": (0.5, 0.6, 0.5)}
    records = [r for r in cells(dial) if r.settings.seed != 4 or r.settings.variant == "none"]
    other = cells({"none": (0.0, 1.0, 0.5)})
    records = [r for r in records if r.settings.seed != 4]
    records += [r for r in other if r.settings.seed == 4]
    found = defect_map(summary_of(records), audit_of({"none": 0.0, "action_gain:1": 0.5}))
    panel = found.panel("floating", "equivariant", "success")
    none, broken = panel.points
    assert none.advantage.value > broken.advantage.value + 0.1
    assert panel.slope is not None
    assert panel.slope.value == pytest.approx(0, abs=1e-9)
    assert panel.fit.policies == 4
    assert panel.reason == "base policies at several defects: 4, 5 are needed"


def test_one_policy_has_a_slope_that_decides_nothing() -> None:
    """It is drawn over the policy's runs, of which three fall and two do not."""
    falls = {"none": (0.5, 0.9, 0.5), "action_gain:1": (0.5, 0.5, 0.5)}
    flat = {"none": (0.5, 0.7, 0.5), "action_gain:1": (0.5, 0.7, 0.5)}
    records = [r for r in cells(falls, policies=1) if r.settings.seed < 3]
    records += [r for r in cells(flat, policies=1) if r.settings.seed >= 3]
    found = defect_map(summary_of(records), audit_of({"none": 0.0, "action_gain:1": 0.5}))
    panel = found.panel("floating", "equivariant", "success")
    assert panel.slope is not None
    slope = panel.slope.interval()
    assert slope.value == pytest.approx(-0.6 * 0.8)
    assert slope.low < -1
    assert slope.high > 0
    assert panel.reason == "base policies at several defects: 1, 5 are needed"


def test_every_dial_has_a_slope() -> None:
    rates = {
        "none": (0.5, 0.6, 0.5),
        "action_gain:0.5": (0.5, 0.6, 0.5),
        "action_gain:1": (0.5, 0.6, 0.5),
        "wind:1": (0.5, 0.2, 0.5),
        "wind:1+obstacle:0.5": (0.5, 0.6, 0.5),
    }
    defects = dict(zip(rates, (0.0, 0.2, 0.4, 0.4, 0.4), strict=True))
    defects["obstacle:0.5+wind:1"] = defects.pop("wind:1+obstacle:0.5")
    found = defect_map(summary_of(cells(rates)), audit_of(defects))
    panel = found.panel("floating", "equivariant", "success")
    slopes = {dial: fit.slope.value for dial, fit in panel.dials.items()}
    assert slopes == pytest.approx({"action_gain": 0.0, "obstacle+wind": 0.0, "wind": -1.0})
    assert panel.slope is not None
    assert -1 < panel.slope.value < 0


def synthetic(
    generator: np.random.Generator, table: Table, policies: int = 6, spread: float = 0.3
) -> list[Point]:
    """Four defects; base policies differ by `spread` in level and by 0.3 in slope, about -0.8.

    Audits are off by as much as they say; each run is off by 0.05.
    """
    levels = generator.normal(0.2, spread, size=policies)
    slopes = generator.normal(-0.8, 0.3, size=policies)
    points = []
    for strength, truth in zip((0.0, 0.3, 0.6, 1.0), (0.0, 0.15, 0.3, 0.5), strict=True):
        measured = float(abs(truth + generator.normal(0, 0.01)))
        defect = Defect(Interval(measured, measured - 0.02, measured + 0.02), "tool")
        pairs = {}
        for policy in range(policies):
            mean = levels[policy] + slopes[policy] * truth + generator.normal(0, 0.05)
            values = enumerate(mean + generator.normal(0, 0.6, size=60))
            pairs[f"policy {policy}", policy] = Sample.pooled(values, f"policy {policy}")
        text = f"wind:{strength}" if strength else "none"
        key = replace(table.key, breaking=(strength > 0, text))
        points.append(Point(replace(table, key=key), defect, pairs))
    return points


def test_the_interval_covers_the_slope() -> None:
    """Whatever the levels of the base policies; their slopes differ, so runs are not the units."""
    table = summary_of(cells({"none": (0.5, 0.6, 0.5)})).tables[0]
    generator = np.random.default_rng(5)
    covered, widths = 0, []
    for trial in range(100):
        found = fit(synthetic(generator, table), resamples=400, seed=trial)
        assert found is not None
        slope = found.slope.interval()
        covered += slope.low <= -0.8 <= slope.high
        widths.append(slope.high - slope.low)
    assert covered >= 90
    assert np.median(widths) < 1.2
    # Levels cancel: a hundred times their spread changes nothing but rounding.
    near, far = (
        fit(synthetic(np.random.default_rng(7), table, spread=s), resamples=400) for s in (0, 30)
    )
    assert near is not None
    assert far is not None
    assert near.slope.value == pytest.approx(far.slope.value, abs=1e-6)


def test_the_interval_covers_the_crossing() -> None:
    """The mean policy's advantage is 0.2 - 0.8 x defect: it ends at 0.25."""
    table = summary_of(cells({"none": (0.5, 0.6, 0.5)})).tables[0]
    generator = np.random.default_rng(6)
    covered, widths = 0, []
    for trial in range(60):
        found = fit(synthetic(generator, table, spread=0.1), resamples=400, seed=trial)
        assert found is not None
        ends = found.crossing()
        low = 0.0 if ends.low is None else ends.low
        high = 0.5 if ends.high is None else ends.high
        covered += low - 0.005 <= 0.25 <= high + 0.005
        widths.append(high - low)
    assert covered >= 53
    assert np.median(widths) < 0.4


def test_an_end_that_0_is_not_excluded_at_is_open() -> None:
    """Undecided from the first defect on, then clearly below 0."""
    rates = {"none": (0.5, 0.5, 0.5), "wind:0.5": (0.5, 0.4, 0.5), "wind:1": (0.5, 0.2, 0.5)}
    audit = audit_of({"none": 0.0, "wind:0.5": 0.2, "wind:1": 0.5})
    found = defect_map(summary_of(cells(rates)), audit).panel("floating", "equivariant", "success")
    ends = found.fit.crossing()
    assert (ends.before, ends.after) == (0, -1)
    assert ends.low is None
    assert 0 < ends.high < 0.5


def test_the_audits_uncertainty_widens_the_slope() -> None:
    def slope(width: float) -> Interval:
        rates = {"none": (0.5, 0.9, 0.5), "wind:1": (0.5, 0.5, 0.5)}
        audit = audit_of({"none": 0.0, "wind:1": 0.4}, width)
        panel = defect_map(summary_of(cells(rates)), audit).panel(
            "floating", "equivariant", "success"
        )
        assert panel.slope is not None
        return panel.slope.interval()

    sure, unsure = slope(0.0), slope(0.15)
    assert sure.value == unsure.value == pytest.approx(-1)
    assert unsure.high - unsure.low > 1.3 * (sure.high - sure.low)


def test_defects_that_are_alike_have_no_slope() -> None:
    rates = {"none": (0.5, 0.9, 0.5), "wind:1": (0.5, 0.5, 0.5)}
    summary, audit = summary_of(cells(rates)), audit_of({"none": 0.1, "wind:1": 0.1})
    found = analyse(summary, audit, read_study(PAPER))
    panel = found.map.panel("floating", "equivariant", "success")
    assert (panel.slope, len(panel.points)) == (None, 2)
    assert panel.reason == "no base policy was steered at two audited defects"
    text = "".join(map_section(summary, found, {}))
    assert panel.reason in text


# What is missing


def test_commands_name_what_has_to_be_measured() -> None:
    summary = summary_of(cells({"none": (0.5, 0.6, 0.5), "wind:1": (0.5, 0.6, 0.5)}))
    keys = [table.key for table in summary.tables]
    assert audit_commands(keys) == [
        "symsteer audit --task PickCube-v1 --embodiment floating --group C8 "
        "--variant none wind:1 --out runs/audit"
    ]


@pytest.mark.parametrize("text", ["a; rm -rf b", "$(x)", "`x`", "a b", "-rf", "a\nb", "x'"])
def test_a_hostile_name_becomes_no_command(text: str) -> None:
    summary = summary_of(cells({text: (0.5, 0.6, 0.5)}))
    assert audit_commands([table.key for table in summary.tables]) == []
