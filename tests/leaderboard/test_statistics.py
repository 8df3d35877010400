"""Statistics against hand-computed values, textbook values and brute force."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable

import numpy as np
import pytest
from scipy import stats

from symsteer.leaderboard.statistics import (
    Array,
    Interval,
    Sample,
    area_under_curve,
    area_weights,
    censored_median,
    crossed_bootstrap,
    deepest_dip,
    episode_weights,
    iqm,
    mean,
    newcombe,
    paired_differences,
    performance_profile,
    probability_of_improvement,
    small_sample_factor,
    steps_to_threshold,
    stratified_bootstrap,
    success_interval,
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


def of(values: Iterable[float], first_seed: int = 0) -> Sample:
    """A run's episodes with the seeds `first_seed`, `first_seed` + 1, ..."""
    return Sample.pooled(enumerate(map(float, values), first_seed))


def width(interval: Interval) -> float:
    return interval.high - interval.low


def test_one_seed_gives_the_interval_of_its_episodes() -> None:
    interval = crossed_bootstrap([of(np.repeat([0.0, 1.0], [40, 60]))])
    assert interval.value == 0.6
    # The Bayesian bootstrap of one Bernoulli sample is a Beta distribution.
    low, high = stats.beta(60, 40).ppf((0.025, 0.975))
    assert (interval.low, interval.high) == (
        pytest.approx(low, abs=0.01),
        pytest.approx(high, abs=0.01),
    )


def test_drawing_runs_equals_its_enumeration() -> None:
    """Numbers without episodes: 3^3 resamples of three runs can be listed."""
    values = np.array([0.0, 1.0, 5.0])
    drawn = np.array([np.mean(draw) for draw in itertools.product(values, repeat=3)])
    widened = 2 + small_sample_factor(3, 2) * (drawn - 2)
    expected = np.quantile(widened, (0.025, 0.975), method="inverted_cdf")
    interval = crossed_bootstrap([Sample.constant(v) for v in values], mean, resamples=200_000)
    assert interval.value == 2.0
    assert (interval.low, interval.high) == pytest.approx(tuple(expected))


def test_five_runs_without_episodes_get_students_interval() -> None:
    """The mean of normal numbers is where the exact interval is known."""
    generator = np.random.default_rng(0)
    ratios = []
    for seed in range(40):
        values = generator.standard_normal(5)
        exact = stats.t(4, values.mean(), stats.sem(values)).interval(0.95)
        found = crossed_bootstrap([Sample.constant(v) for v in values], mean, seed=seed)
        ratios.append(width(found) / (exact[1] - exact[0]))
    assert np.mean(ratios) == pytest.approx(1, abs=0.03)


def test_an_episode_weighs_the_same_for_all_runs() -> None:
    """Five copies of one evaluation have no more information than one; other episodes do."""
    outcomes = np.repeat([0.0, 1.0], 50)
    one = crossed_bootstrap([of(outcomes)])
    copies = crossed_bootstrap([of(outcomes)] * 5)
    assert (copies.low, copies.high) == pytest.approx((one.low, one.high))
    apart = crossed_bootstrap([of(outcomes, 1000 * run) for run in range(5)])
    assert width(apart) < 0.85 * width(copies)
    # The same holds for the same episodes in two evaluations of one run.
    twice = crossed_bootstrap([Sample.pooled([*enumerate(outcomes), *enumerate(outcomes)])])
    assert (twice.low, twice.high) == pytest.approx((one.low, one.high))


def test_a_shared_difficulty_cancels_in_differences() -> None:
    """Episode weights are common, so that only what differs between two agents varies."""
    generator = np.random.default_rng(4)
    hard = generator.random(100)
    runs = [of(hard + 0.1 + 0.001 * generator.standard_normal(100)) for _ in range(5)]
    assert width(crossed_bootstrap(runs)) > 0.05
    differences = [of(block.totals - hard) for sample in runs for block in sample.blocks]
    assert width(crossed_bootstrap(differences)) < 0.001


@pytest.mark.parametrize("statistic", [mean, iqm])
@pytest.mark.parametrize("seeds", [0.0, 0.06, 0.2])
@pytest.mark.parametrize("episodes", [0.0, 0.3])
def test_the_interval_misses_the_truth_in_at_most_one_of_twenty(
    statistic: Callable[..., Array], seeds: float, episodes: float
) -> None:
    """Differences of two agents over 5 seeds and 100 shared episodes, with no true effect.

    The standard deviations span those of the committed runs: over seeds, over episodes (initial
    states that suit one of the agents), and what is left.
    """
    generator = np.random.default_rng(1)
    trials, missed = 300, 0
    for trial in range(trials):
        table = seeds * generator.standard_normal((5, 1)) + 0.4 * generator.standard_normal(
            (5, 100)
        )
        table += episodes * generator.standard_normal(100)
        samples = [of(row) for row in table]
        missed += crossed_bootstrap(samples, statistic, resamples=400, seed=trial).sign != 0
    # Up to 0.05 + three standard errors of such a share.
    assert missed <= stats.binom(trials, 0.05).ppf(0.999)


def test_spread_over_seeds_widens_the_interval() -> None:
    same = [of(np.repeat([0.0, 1.0], 50))] * 4
    apart = [of(np.repeat([0.0, 1.0], [100 - k, k])) for k in (10, 40, 60, 90)]
    narrow, wide = crossed_bootstrap(same), crossed_bootstrap(apart)
    assert narrow.value == wide.value == 0.5
    assert width(wide) > 2 * width(narrow)


def test_the_bootstrap_is_seeded_and_needs_samples() -> None:
    samples = [of(np.random.default_rng(i).random(30)) for i in range(3)]
    assert crossed_bootstrap(samples) == crossed_bootstrap(samples)
    assert crossed_bootstrap(samples) != crossed_bootstrap(samples, seed=1)
    for bad in ([], [of([])], [of([1.0]), of([])]):
        with pytest.raises(ValueError, match="episode"):
            crossed_bootstrap(bad)


def test_unanimous_episodes_get_wilsons_interval() -> None:
    interval = success_interval([of([1.0] * 50), of([1.0] * 50)])
    assert (interval.low, interval.high) == wilson(50, 50)
    assert interval.value == 1.0
    assert success_interval([of([0.0] * 50)]) == Interval(0.0, *wilson(0, 50))


def test_success_stays_a_share() -> None:
    rates = (100, 100, 99, 98, 60)
    interval = success_interval([of(np.repeat([0.0, 1.0], [100 - k, k])) for k in rates])
    assert 0 < interval.low < interval.value < interval.high == 1


def test_paired_differences_use_common_seeds_only() -> None:
    first, second = {3: 1.0, 1: 1.0, 2: 0.0, 9: 1.0}, {1: 0.0, 2: 1.0, 3: 1.0, 7: 1.0}
    assert paired_differences(first, second) == {1: 1.0, 2: -1.0, 3: 0.0}
    assert paired_differences(first, {}) == {}


def test_pairing_narrows_the_interval() -> None:
    generator = np.random.default_rng(0)
    easy = generator.random(200) < 0.5
    better = easy | (generator.random(200) < 0.1)
    paired = crossed_bootstrap([of(better.astype(float) - easy)])
    unpaired = crossed_bootstrap([of(better.astype(float) - generator.permutation(easy))])
    assert paired.sign == 1
    assert width(paired) < 0.6 * width(unpaired)


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
    first, second = of([0.0, 1.0]).blocks[0], of([1.0, 1.0, 0.0, 0.0], 10).blocks[0]
    sample = Sample((first, second), (0.25, 0.75))
    assert sample.value == pytest.approx(0.25 * 0.5 + 0.75 * 0.5)
    assert sample.negated().value == -sample.value
    draws = sample.draw(200_000)
    assert draws.mean() == pytest.approx(0.5, abs=2e-3)
    # Dirichlet weights: p (1 - p) / (n + 1).
    expected = 0.25**2 * 0.25 / 3 + 0.75**2 * 0.25 / 5
    assert draws.var() == pytest.approx(expected, rel=0.02)
    # Blocks of the same episodes move together: half of each is one of them.
    split = Sample((first, first), (0.5, 0.5))
    np.testing.assert_allclose(split.draw(1000), of([0.0, 1.0]).draw(1000))


def test_a_block_pools_the_evaluations_of_an_episode() -> None:
    sample = Sample.pooled([(7, 1.0), (8, 0.0), (7, 0.0), (7, 1.0)])
    block = sample.blocks[0]
    assert (block.seeds, block.totals.tolist(), block.counts.tolist()) == ((7, 8), [2, 0], [3, 1])
    assert sample.value == 0.5
    weights = [episode_weights(seed, 10) for seed in block.seeds]
    expected = 2 * weights[0] / (3 * weights[0] + weights[1])
    np.testing.assert_allclose(sample.draw(10), expected)


def test_cells_are_averaged_and_not_drawn() -> None:
    """Two cells without any spread of their own, far apart: the mean has no width."""
    apart = stratified_bootstrap([[of([1.0, 1.0])] * 5, [of([0.0, 0.0])] * 3])
    assert (apart.value, apart.low, apart.high) == pytest.approx((0.5, 0.5, 0.5))
    generator = np.random.default_rng(1)

    def cell(first_seed: int) -> list[Sample]:
        return [of(generator.random(50) < 0.5, first_seed) for _ in range(5)]

    cells = [cell(100 * k) for k in range(4)]
    ones = [width(stratified_bootstrap([c])) for c in cells]
    four = stratified_bootstrap(cells)
    # Half as wide, and even less, because twenty runs estimate their spread better than five.
    factors = small_sample_factor(5, 16) / small_sample_factor(5, 4)
    assert factors / 2 * np.mean(ones) * 0.8 < width(four) < np.mean(ones) / 2 * 1.15
    assert four.value == pytest.approx(np.mean([sample.value for c in cells for sample in c]))
    # The same episodes in every cell are drawn once: they do not average out.
    shared = stratified_bootstrap([[of(np.repeat([0.0, 1.0], 25))] * 5] * 4)
    assert width(shared) == pytest.approx(width(crossed_bootstrap([of(np.repeat([0.0, 1.0], 25))])))
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
    ours = crossed_bootstrap([Sample.constant(run) for run in column[:, 0]], iqm, resamples=10_000)
    assert ours.value == pytest.approx(value)
    # Theirs without the widening for five runs.
    narrow = [value + (end - value) / small_sample_factor(5, 4) for end in (ours.low, ours.high)]
    assert narrow == pytest.approx(ends, abs=0.015)

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
