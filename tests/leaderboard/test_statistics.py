"""Statistics against hand-computed values, textbook values and brute force."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from scipy import stats

from leaderboard.statistics import (
    Interval,
    Sample,
    area_under_curve,
    area_weights,
    censored_median,
    deepest_dip,
    iqm,
    mean,
    newcombe,
    paired_differences,
    performance_profile,
    probability_of_improvement,
    steps_to_threshold,
    stratified_bootstrap,
    success_interval,
    two_stage_bootstrap,
    wilson,
)


def test_iqm_drops_a_quarter_on_either_side() -> None:
    assert iqm([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 100.0]) == 3.5
    assert iqm([0.0, 0.2, 0.4, 0.6, 10.0]) == pytest.approx(0.4)
    assert iqm([0.0, 1.0, 5.0]) == 2.0
    values = np.random.default_rng(0).random((40, 7))
    by_hand = np.sort(values, axis=0)[10:30].mean(axis=0)
    np.testing.assert_allclose(iqm(values, axis=0), by_hand)


def test_wilson_has_its_textbook_values() -> None:
    assert wilson(0, 10) == pytest.approx((0.0, 0.27753), abs=1e-5)
    assert wilson(81, 263) == pytest.approx((0.25527, 0.36621), abs=1e-4)


def test_one_seed_gives_the_interval_of_its_episodes() -> None:
    episodes = np.repeat([0.0, 1.0], [40, 60])
    interval = two_stage_bootstrap([episodes])
    assert interval.value == 0.6
    # The bootstrap of one Bernoulli sample is a binomial count divided by n.
    normal = 1.96 * np.sqrt(0.6 * 0.4 / 100)
    assert interval.low == pytest.approx(0.6 - normal, abs=0.015)
    assert interval.high == pytest.approx(0.6 + normal, abs=0.015)


def test_the_bootstrap_equals_its_enumeration() -> None:
    """Two seeds of two episodes have 4 x 4 resamples of seeds and episodes that can be listed."""
    samples = [[0.0, 1.0], [1.0, 2.0]]
    outcomes = []
    for first, second in itertools.product(samples, repeat=2):
        means = [np.mean(draw) for draw in itertools.product(first, repeat=2)]
        others = [np.mean(draw) for draw in itertools.product(second, repeat=2)]
        outcomes += [(m + n) / 2 for m, n in itertools.product(means, others)]
    low, high = np.quantile(outcomes, (0.025, 0.975))
    interval = two_stage_bootstrap(samples, mean, resamples=200_000)
    assert interval.value == 1.0
    assert (interval.low, interval.high) == (pytest.approx(low), pytest.approx(high))


def test_the_interval_covers_the_truth_at_least_as_often_as_it_says() -> None:
    generator = np.random.default_rng(3)
    covered = 0
    for trial in range(200):
        rates = np.clip(generator.normal(0.5, 0.08, size=5), 0, 1)
        samples = [generator.random(60) < rate for rate in rates]
        interval = two_stage_bootstrap(samples, resamples=400, seed=trial)
        covered += interval.low <= 0.5 <= interval.high
    assert covered >= 0.93 * 200


def test_spread_over_seeds_widens_the_interval() -> None:
    same = [np.repeat([0.0, 1.0], 50)] * 4
    apart = [np.repeat([0.0, 1.0], [100 - k, k]) for k in (10, 40, 60, 90)]
    narrow, wide = two_stage_bootstrap(same), two_stage_bootstrap(apart)
    assert narrow.value == wide.value == 0.5
    assert wide.high - wide.low > 2 * (narrow.high - narrow.low)


def test_the_bootstrap_is_seeded_and_needs_samples() -> None:
    samples = [np.random.default_rng(i).random(30) for i in range(3)]
    assert two_stage_bootstrap(samples) == two_stage_bootstrap(samples)
    assert two_stage_bootstrap(samples) != two_stage_bootstrap(samples, seed=1)
    for bad in ([], [[]], [[1.0], []]):
        with pytest.raises(ValueError, match="episode"):
            two_stage_bootstrap(bad)


def test_unanimous_episodes_get_wilsons_interval() -> None:
    interval = success_interval([[1.0] * 50, [1.0] * 50])
    assert (interval.low, interval.high) == wilson(100, 100)
    assert interval.value == 1.0
    assert interval.low < 0.97


def test_paired_differences_use_common_seeds_only() -> None:
    first, second = {3: 1.0, 1: 1.0, 2: 0.0, 9: 1.0}, {1: 0.0, 2: 1.0, 3: 1.0, 7: 1.0}
    assert sorted(paired_differences(first, second)) == [-1.0, 0.0, 1.0]
    assert paired_differences(first, {}).size == 0


def test_pairing_narrows_the_interval() -> None:
    generator = np.random.default_rng(0)
    easy = generator.random(200) < 0.5
    better = easy | (generator.random(200) < 0.1)
    paired = two_stage_bootstrap([better.astype(float) - easy])
    unpaired = two_stage_bootstrap([better.astype(float) - generator.permutation(easy)])
    assert paired.sign == 1
    assert paired.high - paired.low < 0.6 * (unpaired.high - unpaired.low)


def test_signs_say_whether_zero_is_excluded() -> None:
    assert Interval(0.1, 0.01, 0.2).sign == 1
    assert Interval(-0.1, -0.2, -0.01).sign == -1
    assert Interval(0.1, 0.0, 0.2).sign == Interval(0.0, -0.1, 0.1).sign == 0


def test_area_under_curve() -> None:
    assert area_under_curve([0, 100], [0.0, 1.0], 100) == pytest.approx(0.5)
    assert area_under_curve([0, 50, 100], [0.0, 1.0, 1.0], 100) == pytest.approx(0.75)
    assert area_under_curve([100], [0.4], 100) == pytest.approx(0.4)
    assert area_under_curve([50], [0.4], 100) == pytest.approx(0.4)
    # Starts late and ends early: the ends are held.
    assert area_under_curve([20, 60], [0.2, 0.6], 100) == pytest.approx(0.04 + 0.16 + 0.24)
    # What lies beyond the budget does not count.
    assert area_under_curve([0, 200], [0.0, 1.0], 100) == pytest.approx(0.25)


def test_steps_to_threshold_and_their_median() -> None:
    assert steps_to_threshold([0, 10, 20], [0.1, 0.5, 0.6], 0.5) == 10
    assert steps_to_threshold([0, 10, 20], [0.9, 0.1, 0.5], 0.5) == 20
    assert steps_to_threshold([0, 10, 20], [0.9, 0.9, 0.4], 0.5) is None
    assert steps_to_threshold([0, 10, 20], [0.1, 0.5, 0.4], 0.6) is None
    assert censored_median([10, None, 30]) == 30
    assert censored_median([10, 20]) == 15
    assert censored_median([10, None]) is None
    assert censored_median([None, None, 5]) is None


def test_the_dip_is_the_lowest_difference_or_nothing() -> None:
    assert deepest_dip([0.1, -0.2, 0.4]) == -0.2
    assert deepest_dip([0.1, 0.4]) == 0.0


def test_newcombe_has_its_textbook_values() -> None:
    """Newcombe 1998, table II, method 10."""
    textbook = {
        ((56, 70), (48, 80)): (0.2, 0.0524, 0.3339),
        ((9, 10), (3, 10)): (0.6, 0.1705, 0.8090),
        ((5, 56), (0, 29)): (0.0893, -0.0381, 0.1926),
        ((10, 10), (0, 10)): (1.0, 0.6075, 1.0),
    }
    for (first, second), (value, low, high) in textbook.items():
        found = newcombe(first, second)
        assert (found.value, found.low, found.high) == pytest.approx((value, low, high), abs=5e-5)


def test_area_weights_give_the_area() -> None:
    generator = np.random.default_rng(0)
    for steps in ([0, 50, 100], [20, 60, 130], [70]):
        values = generator.random(len(steps))
        area = area_under_curve(steps, values.tolist(), 100)
        assert np.dot(area_weights(steps, 100), values) == pytest.approx(area)


def test_a_sample_weighs_its_blocks() -> None:
    sample = Sample((np.array([0.0, 1.0]), np.array([1.0, 1.0, 0.0, 0.0])), (0.25, 0.75))
    assert sample.value == pytest.approx(0.5)
    draws = sample.draw(200_000, np.random.default_rng(0))
    assert draws.mean() == pytest.approx(0.5, abs=2e-3)
    expected = 0.25**2 * 0.25 / 2 + 0.75**2 * 0.25 / 4
    assert draws.var() == pytest.approx(expected, rel=0.02)
    split = Sample((np.array([0.0, 1.0]), np.array([0.0, 1.0])), (0.5, 0.5))
    one = two_stage_bootstrap([split, split], resamples=20_000)
    whole = two_stage_bootstrap([[0.0, 0.0, 1.0, 1.0]] * 2, resamples=20_000)
    assert one.high - one.low == pytest.approx(whole.high - whole.low, abs=0.03)


def test_cells_are_averaged_and_not_drawn() -> None:
    """Two cells without any spread of their own, far apart: the mean has no width."""
    apart = stratified_bootstrap([[[1.0, 1.0]] * 5, [[0.0, 0.0]] * 3])
    assert apart == Interval(0.5, 0.5, 0.5)
    generator = np.random.default_rng(1)
    cells = [[(generator.random(50) < 0.5).astype(float) for _ in range(5)] for _ in range(4)]
    one, four = stratified_bootstrap(cells[:1]), stratified_bootstrap(cells)
    assert four.high - four.low == pytest.approx((one.high - one.low) / 2, rel=0.35)
    assert four.value == pytest.approx(np.mean(cells))
    with pytest.raises(ValueError, match="cell"):
        stratified_bootstrap([])


def test_probability_of_improvement_by_hand() -> None:
    # 3 beats 1, 2; ties with 3: 2.5 of 3. 1 ties with 1: 0.5 of 3. Together 3 of 6.
    assert probability_of_improvement([([3, 1], [1, 2, 3])]).value == pytest.approx(0.5)
    sure = probability_of_improvement([([2, 3], [0, 1])])
    assert (sure.value, sure.low, sure.high) == (1.0, 1.0, 1.0)
    # The mean over cells, however many runs each has.
    mixed = probability_of_improvement([([1], [0]), ([0, 0, 0], [1, 1, 1])])
    assert mixed.value == pytest.approx(0.5)
    for bad in ([], [([], [1])], [([1], [])]):
        with pytest.raises(ValueError, match="runs"):
            probability_of_improvement(bad)


def test_probability_of_improvement_is_mann_whitneys() -> None:
    generator = np.random.default_rng(2)
    x, y = generator.integers(0, 5, 9).tolist(), generator.integers(0, 5, 6).tolist()
    expected = stats.mannwhitneyu(x, y).statistic / 54
    here, there = probability_of_improvement([(x, y)]), probability_of_improvement([(y, x)])
    assert here.value == pytest.approx(expected)
    assert here.value + there.value == pytest.approx(1)
    assert here.low < expected < here.high


def test_the_interval_of_the_probability_equals_its_enumeration() -> None:
    x, y = [0.2, 0.6], [0.1, 0.6]
    draws = [
        np.mean([(a > b) + 0.5 * (a == b) for a in first for b in second])
        for first in itertools.product(x, repeat=2)
        for second in itertools.product(y, repeat=2)
    ]
    found = probability_of_improvement([(x, y)], resamples=100_000)
    expected = np.quantile(draws, (0.025, 0.975), method="inverted_cdf")
    assert (found.low, found.high) == tuple(expected)


def test_performance_profiles_by_hand() -> None:
    cells = [[0.1, 0.5], [0.5, 0.5, 0.9, 0.9]]
    share, low, high = performance_profile(cells, [0.0, 0.5, 0.6, 1.0])
    assert share == pytest.approx([1.0, 0.75, 0.25, 0.0])
    assert low[[0, 3]].tolist() == high[[0, 3]].tolist() == [1.0, 0.0]
    assert (low[1], high[1]) == (0.5, 1.0)
    with pytest.raises(ValueError, match="runs"):
        performance_profile([[]], [0.5])


def test_statistics_agree_with_rliable() -> None:
    """IQM, its stratified interval, P(X > Y) and profiles of five runs on twelve tasks."""
    library = pytest.importorskip("rliable.library")
    metrics = pytest.importorskip("rliable.metrics")
    generator = np.random.default_rng(0)
    first = 0.5 + 0.3 * generator.random((5, 12))
    second = 0.45 + 0.3 * generator.random((5, 12))
    assert iqm(first.ravel()) == pytest.approx(metrics.aggregate_iqm(first))

    def intervals(scores: object, metric: object) -> tuple[float, list[float]]:
        state = np.random.RandomState(0)
        value, ends = library.get_interval_estimates(
            {"x": scores}, metric, reps=3000, random_state=state
        )
        return float(np.ravel(value["x"])[0]), np.ravel(ends["x"]).tolist()

    column = first[:, [0]]
    value, ends = intervals(column, lambda x: np.array([metrics.aggregate_iqm(x)]))
    ours = two_stage_bootstrap([[run] for run in column[:, 0]], iqm, resamples=10_000)
    assert ours.value == pytest.approx(value)
    assert (ours.low, ours.high) == pytest.approx(ends, abs=0.015)

    value, ends = intervals((first, second), metrics.probability_of_improvement)
    ours = probability_of_improvement(list(zip(first.T, second.T, strict=True)))
    assert ours.value == pytest.approx(value)
    assert (ours.low, ours.high) == pytest.approx(ends, abs=0.015)

    levels = np.linspace(0.41, 0.89, 7)
    share, low, high = performance_profile(list(first.T), levels)
    shares, bands = library.create_performance_profile({"x": first}, levels, reps=1000)
    assert share == pytest.approx(shares["x"])
    assert low == pytest.approx(bands["x"][0], abs=0.025)
    assert high == pytest.approx(bands["x"][1], abs=0.025)
