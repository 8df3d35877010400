"""How the advantage of symmetry changes with the defect: the slope, its interval, where it ends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from symsteer.leaderboard.advantage_by_defect import Fit, Point, fit, points_of
from symsteer.leaderboard.defects import Audit, AuditedDefect
from symsteer.leaderboard.records import RunRecord
from symsteer.leaderboard.rows import Summary, Table
from symsteer.leaderboard.statistics import Interval, Sample
from tests.leaderboard.record_factory import audit_of, make_cell, steered, summary_of


def values(summary: Summary, audit: Audit, agent: str, measure: str = "success") -> list[float]:
    points = points_of(summary, audit, "floating", agent, measure)
    return [point.advantage.value for point in points]


def fitted(
    summary: Summary, audit: Audit, agent: str = "equivariant", measure: str = "success"
) -> Fit:
    found = fit(points_of(summary, audit, "floating", agent, measure))
    assert found is not None
    return found


def test_every_audited_cell_is_paired_and_placed() -> None:
    cells = {"none": (0.5, 0.9, 0.8), "wind:1": (0.5, 0.3, 0.5), "obstacle:1": (0.0, 1.0, 1.0)}
    summary, audit = summary_of(steered(cells)), audit_of({"none": 0.01, "wind:1": 0.3})
    points = points_of(summary, audit, "floating", "equivariant", "success")
    assert [point.defect.value for point in points] == [0.01, 0.3]
    assert [point.advantage.value for point in points] == pytest.approx([0.4, -0.2])
    assert [point.dial for point in points] == ["none", "wind"]
    assert values(summary, audit, "approximate", "auc") == pytest.approx([0.3, 0.0])
    assert values(summary, audit, "augmented") == []


def test_the_area_is_measured_along_the_whole_curve() -> None:
    records = make_cell({"standard": (0.0, 0.5, 0.5), "equivariant": (0.0, 1.0, 0.5)})
    summary, audit = summary_of(records), audit_of({"none": 0.0})
    assert values(summary, audit, "equivariant", "auc") == pytest.approx([0.25])
    assert values(summary, audit, "equivariant") == pytest.approx([0.0])


def test_cells_have_the_usual_budget_and_demonstrations() -> None:
    rates = {"standard": 0.5, "equivariant": 0.7}
    summary = summary_of(
        make_cell(rates),
        make_cell(rates, variant="wind:1"),
        make_cell(rates, variant="wind:1", env_steps=500_000),
        make_cell(rates, demonstrations={"mode": "diverse", "count": 5, "seed": 0}),
        make_cell(rates, task="PushT-v1", variant="wind:1", env_steps=500_000),
    )
    audit = audit_of({"none": 0.0, "wind:1": 0.4}) | audit_of({"wind:1": 0.4}, task="PushT-v1")
    keys = [p.table.key for p in points_of(summary, audit, "floating", "equivariant", "auc")]
    assert [(k.variant, k.env_steps, k.demonstrations) for k in keys] == [
        ("none", 50_000, 50),
        ("wind:1", 50_000, 50),
        ("wind:1", 500_000, 50),
    ]


@pytest.mark.parametrize("measure", ["auc", "success"])
def test_a_slope_is_recovered(measure: str) -> None:
    """0.3 - 1 x defect, with five base policies."""
    variants = ("none", "action_gain:0.25", "action_gain:0.5", "action_gain:1", "wind:1")
    defects = dict(zip(variants, (0.0, 0.1, 0.2, 0.4, 0.5), strict=True))
    summary = summary_of(steered({v: (0.5, 0.8 - d, 0.8) for v, d in defects.items()}))
    audit = audit_of(defects, width=0.02)
    found = fitted(summary, audit, measure=measure)
    slope = found.slope.interval()
    assert slope.value == pytest.approx(-1, abs=0.02)
    assert -1.3 < slope.low < -1 < slope.high < -0.7
    assert (found.reason, found.policies) == ("", 5)
    (line,) = found.lines
    assert line.centre == pytest.approx((0.24, 0.06))
    assert line.span == (0.0, 0.5)
    ends = found.crossing()
    assert ends.value == pytest.approx(0.3, abs=0.01)
    assert 0.1 < ends.low < 0.3 < ends.high < 0.5
    assert (ends.before, ends.after) == (1, -1)
    flat = fitted(summary, audit, "approximate", measure)
    assert flat.slope.interval().sign == 0
    never = flat.crossing()
    assert (never.value, never.low, never.high) == (None, None, None)
    assert (never.before, never.after) == (1, 1)


def test_policies_and_tasks_have_levels_of_their_own() -> None:
    """Between two tasks the advantage falls by 0.4; along each one's dial not at all."""
    dial = {"none": (0.5, 0.9, 0.5), "action_gain:1": (0.5, 0.9, 0.5)}
    low = dict.fromkeys(dial, (0.5, 0.5, 0.5))
    audit = {
        **audit_of({"none": 0.0, "action_gain:1": 0.1}),
        **audit_of({"none": 0.4, "action_gain:1": 0.5}, task="PushCube-v1"),
    }
    found = fitted(summary_of(steered(dial), steered(low, task="PushCube-v1")), audit)
    assert found.slope.value == pytest.approx(0, abs=1e-9)
    assert found.policies == 10
    centres = np.array(sorted(line.centre for line in found.lines))
    assert centres == pytest.approx(np.array([[0.05, 0.4], [0.45, 0.0]]))


def test_a_policy_that_is_not_in_all_cells_does_not_tilt_the_line() -> None:
    dial = {"none": (0.5, 0.6, 0.5), "action_gain:1": (0.5, 0.6, 0.5)}
    records = [r for r in steered(dial) if r.settings.seed != 4]
    records += [r for r in steered({"none": (0.0, 1.0, 0.5)}) if r.settings.seed == 4]
    summary, audit = summary_of(records), audit_of({"none": 0.0, "action_gain:1": 0.5})
    none, broken = values(summary, audit, "equivariant")
    assert none > broken + 0.1
    found = fitted(summary, audit)
    assert found.slope.value == pytest.approx(0, abs=1e-9)
    assert (found.policies, found.reason) == (
        4,
        "base policies at several defects: 4, 5 are needed",
    )


def test_one_policy_has_a_slope_that_decides_nothing() -> None:
    """It is drawn over the policy's runs, of which three fall and two do not."""

    def of(rates: tuple[float, float], seeds: range) -> list[RunRecord]:
        none, broken = rates
        cell = {"none": (0.5, none, 0.5), "action_gain:1": (0.5, broken, 0.5)}
        return [r for r in steered(cell, policies=1) if r.settings.seed in seeds]

    summary = summary_of(of((0.9, 0.5), range(3)), of((0.7, 0.7), range(3, 5)))
    found = fitted(summary, audit_of({"none": 0.0, "action_gain:1": 0.5}))
    slope = found.slope.interval()
    assert slope.value == pytest.approx(-0.6 * 0.8)
    assert slope.low < -0.9
    assert slope.high > 0
    assert found.reason == "base policies at several defects: 1, 5 are needed"


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
        defect = AuditedDefect(Interval(measured, measured - 0.02, measured + 0.02), "tool")
        pairs = {}
        for policy in range(policies):
            mean = levels[policy] + slopes[policy] * truth + generator.normal(0, 0.05)
            episodes = enumerate(mean + generator.normal(0, 0.6, size=60))
            pairs[f"policy {policy}", policy] = Sample.pooled(episodes, f"policy {policy}")
        text = f"wind:{strength}" if strength else "none"
        key = replace(table.key, breaking=(strength > 0, text))
        points.append(Point(replace(table, key=key), defect, pairs))
    return points


def test_the_intervals_cover_slope_and_crossing() -> None:
    """Whatever the levels of the base policies; their slopes differ, so runs are not the units.

    The mean policy's advantage is 0.2 - 0.8 x defect: it ends at 0.25.
    """
    table = summary_of(steered({"none": (0.5, 0.6, 0.5)})).tables[0]
    generator = np.random.default_rng(5)
    covered, widths, crossed, lengths = 0, [], 0, []
    for trial in range(60):
        found = fit(synthetic(generator, table, spread=0.1), resamples=400, seed=trial)
        assert found is not None
        slope, ends = found.slope.interval(), found.crossing()
        covered += slope.low <= -0.8 <= slope.high
        widths.append(slope.high - slope.low)
        low, high = 0.0 if ends.low is None else ends.low, 0.5 if ends.high is None else ends.high
        crossed += low - 0.005 <= 0.25 <= high + 0.005
        lengths.append(high - low)
    assert min(covered, crossed) >= 53
    assert np.median(widths) < 1.2
    assert np.median(lengths) < 0.4
    # Levels cancel: a hundred times their spread changes nothing but rounding.
    near, far = (
        fit(synthetic(np.random.default_rng(7), table, spread=s), resamples=400) for s in (0, 30)
    )
    assert near.slope.value == pytest.approx(far.slope.value, abs=1e-6)


def test_an_end_that_0_is_not_excluded_at_is_open() -> None:
    """Undecided from the first defect on, then clearly below 0."""
    rates = {"none": (0.5, 0.5, 0.5), "wind:0.5": (0.5, 0.4, 0.5), "wind:1": (0.5, 0.2, 0.5)}
    audit = audit_of({"none": 0.0, "wind:0.5": 0.2, "wind:1": 0.5})
    ends = fitted(summary_of(steered(rates)), audit).crossing()
    assert (ends.before, ends.after) == (0, -1)
    assert ends.low is None
    assert 0 < ends.high < 0.5


def test_the_audits_uncertainty_widens_the_slope() -> None:
    summary = summary_of(steered({"none": (0.5, 0.9, 0.5), "wind:1": (0.5, 0.5, 0.5)}))
    defects = {"none": 0.0, "wind:1": 0.4}
    sure, unsure = (
        fitted(summary, audit_of(defects, width)).slope.interval() for width in (0.0, 0.15)
    )
    assert sure.value == unsure.value == pytest.approx(-1)
    assert unsure.high - unsure.low > 1.3 * (sure.high - sure.low)
