"""Statistics against hand-computed values, textbook values and brute force."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from leaderboard.statistics import (
    Interval,
    area_under_curve,
    censored_median,
    deepest_dip,
    final_window_mean,
    iqm,
    mean,
    paired_differences,
    steps_to_threshold,
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
    assert paired_differences(first, second).tolist() == [1.0, -1.0, 0.0]
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
    assert steps_to_threshold([0, 10, 20], [0.1, 0.5, 0.4], 0.5) == 10
    assert steps_to_threshold([0, 10, 20], [0.1, 0.5, 0.4], 0.6) is None
    assert censored_median([10, None, 30]) == 30
    assert censored_median([10, 20]) == 15
    assert censored_median([10, None]) is None
    assert censored_median([None, None, 5]) is None


def test_dip_and_final_window() -> None:
    assert deepest_dip([0.4, 0.1, 0.7], 0.3) == pytest.approx(-0.2)
    assert deepest_dip([0.4, 0.7], 0.3) == 0.0
    assert final_window_mean([0, 50, 80, 100], [0.0, 0.1, 0.5, 0.7], 100) == pytest.approx(0.6)
    assert final_window_mean([0, 50], [0.0, 0.3], 100) == pytest.approx(0.3)
