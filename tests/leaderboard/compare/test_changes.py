"""Differences, intervals and the verdict."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from symsteer.leaderboard.runs import episode_success
from symsteer.leaderboard.statistics import Sample, crossed_bootstrap, paired_differences
from tests.leaderboard.compare.runs import changed, runs_of, save
from tests.leaderboard.record_factory import edited, make_cell

EPISODES = 40


def curves(rate: float, runs: int = 5, flat: bool = True, salt: int = 0) -> list[list[list[int]]]:
    """Three evaluations for each run; exactly `rate` of the episodes succeed, others in each."""
    found = []
    for seed in range(runs):
        generator = np.random.default_rng((salt, seed))
        found.append(
            [
                (generator.permutation(EPISODES) < round(share * EPISODES)).astype(int).tolist()
                for share in ((rate if flat else 0.0), rate, rate)
            ]
        )
    return found


def sides(tmp_path: Path, a, b, **options):
    return save(tmp_path / "a", a), save(tmp_path / "b", b)


def test_differences_are_b_minus_a(tmp_path: Path):
    a, b = sides(tmp_path, runs_of(*curves(0.5)), runs_of(*curves(0.75, flat=False, salt=1)))
    found = changed(a, b)
    success, auc = found.overall["success"], found.overall["auc"]
    assert (success.a, success.b) == pytest.approx((0.5, 0.75))
    assert success.difference.value == pytest.approx(0.25)
    # B's curve rises from 0 in the first half of the budget.
    assert (auc.a, auc.b) == pytest.approx((0.5, 0.75 * 0.75))
    assert auc.difference.value == pytest.approx(0.75 * 0.75 - 0.5)
    back = changed(b, a).overall["success"].difference
    assert (back.value, back.low, back.high) == pytest.approx(
        (-success.difference.value, -success.difference.high, -success.difference.low)
    )


def test_intervals_are_those_of_the_leaderboard_on_shared_episodes(tmp_path: Path):
    """Of five base policies; differences are paired by episode."""
    a, b = runs_of(*curves(0.5), policies=True), runs_of(*curves(0.6, salt=1), policies=True)
    found = changed(*sides(tmp_path, a, b)).overall
    success, auc = [], []
    for one, two in zip(a, b, strict=True):
        blocks = [
            Sample.pooled(paired_differences(episode_success(y), episode_success(x)).items())
            for x, y in zip(one.evaluations, two.evaluations, strict=True)
        ]
        blocks, policy = [sample.blocks[0] for sample in blocks], one.base_policy.content_hash
        success.append(Sample((blocks[-1],), policy=policy))
        # The trapezoidal rule, of evaluations at 0, a half and all of the budget.
        auc.append(Sample(tuple(blocks), (0.25, 0.5, 0.25), policy))
    for name, samples in (("success", success), ("auc", auc)):
        interval, wanted = found[name].difference, crossed_bootstrap(samples)
        assert (interval.value, interval.low, interval.high) == pytest.approx(
            (wanted.value, wanted.low, wanted.high), abs=1e-9
        )
        assert interval.low < interval.value < interval.high


def test_the_mean_over_cells_is_over_those_with_enough_pairs(tmp_path: Path):
    a = runs_of(*curves(0.5)) + runs_of(*curves(0.5), variant="wind:1")
    b = runs_of(*curves(0.6, salt=1)) + runs_of(*curves(0.3, salt=1), variant="wind:1")
    few = {"variant": "wind:0.5"}
    a += runs_of(*curves(0.5, 4), **few)
    b += runs_of(*curves(1.0, 4), **few)
    found = changed(*sides(tmp_path, a, b))
    by_variant = {cell.key.variant: cell.measures["success"] for cell in found.cells}
    assert {name: round(c.difference.value, 9) for name, c in by_variant.items()} == {
        "none": 0.1,
        "wind:0.5": 0.5,
        "wind:1": -0.2,
    }
    assert [name for name, c in by_variant.items() if not c.counts] == ["wind:0.5"]
    overall = found.overall["success"]
    assert overall.difference.value == pytest.approx(-0.05)
    assert (overall.a, overall.b, overall.pairs) == (pytest.approx(0.5), pytest.approx(0.45), 10)
    assert overall.counts


def test_the_bias_of_q_is_compared_by_its_size(tmp_path: Path):
    a, b = runs_of(*curves(0.5)), runs_of(*curves(0.5, salt=1))
    last = "evaluations/-1/diagnostics"
    b = [edited(b[0], {last: {}}), *(edited(record, {f"{last}/q_bias": 0.5}) for record in b[1:])]
    found = changed(*sides(tmp_path, a, b)).overall["q_bias"]
    # A's are -1 to -5; the first run of B has none.
    assert found.pairs == 4
    assert (found.a, found.b, found.difference.value) == pytest.approx((3.5, 0.5, -3.0))


def test_references_have_no_curve(tmp_path: Path):
    a, b = (make_cell({"base": rate}, episodes=EPISODES) for rate in (0.5, 0.75))
    found = changed(*sides(tmp_path, a, b))
    assert "auc" not in found.overall
    assert found.overall["success"].difference.value == pytest.approx(0.25)
    assert found.verdict == "better"


@pytest.mark.parametrize(
    ("rate", "margin", "verdict"),
    [(0.1, 0.0, "worse"), (0.1, 0.9, "not worse"), (0.9, 0.0, "better"), (0.5, 0.0, "not worse")],
)
def test_the_verdict(tmp_path: Path, rate, margin, verdict):
    a, b = sides(tmp_path, runs_of(*curves(0.5)), runs_of(*curves(rate, salt=1)))
    found = changed(a, b, margin=margin)
    assert found.verdict == verdict
    if verdict == "worse":
        # The interval must end below the margin.
        lowest = min(found.overall[name].difference.high for name in ("success", "auc"))
        assert changed(a, b, margin=-lowest - 1e-6).verdict == "worse"
        assert changed(a, b, margin=-lowest).verdict == "not worse"


def test_success_alone_or_the_area_alone_is_enough(tmp_path: Path):
    late = [[[0] * EPISODES, [0] * EPISODES, run[-1]] for run in curves(0.8)]
    a, b = sides(tmp_path, runs_of(*curves(0.8)), runs_of(*late))
    found = changed(a, b)
    assert found.overall["success"].difference.sign == 0
    assert found.verdict == "worse"
    # Better in one and worse in the other, within the margin.
    assert changed(a, b, margin=1.0).verdict == "not worse"
    end = [[*run[:2], [0] * EPISODES] for run in curves(0.02)]
    start = [[*run[:2], [1] * 4 + [0] * (EPISODES - 4)] for run in curves(0.02)]
    a, b = save(tmp_path / "c", runs_of(*start)), save(tmp_path / "d", runs_of(*end))
    assert changed(a, b).overall["success"].difference.high < 0
    assert changed(a, b).verdict == "worse"
