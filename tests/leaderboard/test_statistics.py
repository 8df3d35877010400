"""Statistics against hand-computed values, textbook values and brute force."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
import pytest
from scipy import stats

from symsteer.leaderboard.records.measures import area_under_curve, wilson
from symsteer.leaderboard.statistics import (
    Array,
    Effect,
    Interval,
    Sample,
    ShareDifference,
    area_weights,
    cell_estimates,
    censored_median,
    combined,
    crossed_bootstrap,
    degrees_of_freedom,
    episode_weights,
    holm,
    iqm,
    mean,
    p_difference,
    p_equivalence,
    performance_profile,
    probability_of_improvement,
    spread,
    steps_to_threshold,
    stratified_bootstrap,
    success_interval,
)


def test_iqm_drops_a_quarter_on_either_side() -> None:
    assert iqm([0.0, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 100.0]) == 3.5
    assert iqm([0.0, 0.2, 0.4, 0.6, 10.0]) == pytest.approx(0.4)
    assert iqm([0.0, 1.0, 5.0]) == 2.0
    values = np.random.default_rng(0).random((7, 40))
    by_hand = np.sort(values, axis=1)[:, 10:30].mean(axis=1)
    np.testing.assert_allclose(iqm(values), by_hand)


@pytest.mark.parametrize("number", [1, 3, 4, 5, 11])
def test_weights_of_the_iqm_are_like_copies(number: int) -> None:
    values = np.random.default_rng(number).random((6, number))
    np.testing.assert_allclose(iqm(values, np.full(values.shape, 0.3)), iqm(values))
    # Four values, twice of one and none of another: its copy takes its place.
    copied = iqm([0.0, 1.0, 1.0, 8.0])
    assert iqm([0.0, 1.0, 5.0, 8.0], np.array([1.0, 2.0, 0.0, 1.0])) == pytest.approx(copied)


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


def test_five_runs_without_episodes_get_students_interval_and_p_value() -> None:
    """The mean of normal numbers is where both are known exactly."""
    generator = np.random.default_rng(0)
    ratios, p_values = [], []
    for _ in range(40):
        values = generator.standard_normal(5) + 0.5
        exact = stats.t(4, values.mean(), stats.sem(values)).interval(0.95)
        found = cell_estimates([[Sample.constant(v) for v in values]])[0]
        ratios.append(width(found.interval()) / (exact[1] - exact[0]))
        p_values.append((p_difference(found), stats.ttest_1samp(values, 0).pvalue))
    assert np.mean(ratios) == pytest.approx(1, abs=0.03)
    p_values = np.log(p_values)
    assert np.abs(p_values[:, 0] - p_values[:, 1]).mean() < 0.2


def by_policy(table: Array, shared: bool = True) -> list[Sample]:
    """Runs [policies, runs, episodes] of as many policies, on one list of episodes."""
    policies, runs, episodes = table.shape
    return [
        Sample.pooled(
            enumerate(table[p, r], 0 if shared else episodes * (p * runs + r)), policy=f"policy {p}"
        )
        for p in range(policies)
        for r in range(runs)
    ]


def test_policies_are_drawn_with_all_their_runs() -> None:
    """More runs of five policies narrow the interval little where the policies differ."""
    generator = np.random.default_rng(2)
    policies = generator.standard_normal((5, 1, 1))
    one = crossed_bootstrap(by_policy(policies))
    many = by_policy(np.repeat(policies, 8, axis=1))
    assert crossed_bootstrap(many) == one
    # Runs of one policy are not copies of it: as many, seen as runs alone, would look precise.
    alone = [Sample(run.blocks) for run in many]
    assert width(crossed_bootstrap(alone)) < 0.4 * width(one)
    # Policies count alike, however many runs each has.
    uneven = [Sample.constant(v, p) for v, p in ((0.0, "a"), (1.0, "b"), (1.0, "b"), (1.0, "b"))]
    assert crossed_bootstrap(uneven).value == 0.5


def test_a_policy_is_drawn_once_for_all_cells_that_steer_it() -> None:
    """Four variants of one world: the mean over them is as uncertain as the policies are."""
    generator = np.random.default_rng(3)
    policies = generator.standard_normal((5, 1, 1))
    cells = [by_policy(policies + 0.01 * generator.standard_normal((5, 1, 1))) for _ in range(4)]
    assert degrees_of_freedom([["a", "b"], ["b", "c"], ["d", "e", "f"]]) == 4
    together, alone = stratified_bootstrap(cells), crossed_bootstrap(cells[0])
    assert width(together) == pytest.approx(width(alone), rel=0.05)
    # In the difference of two of them the policies cancel.
    estimates = cell_estimates(cells)
    assert width(combined(estimates[:2], [1, -1]).interval()) < 0.05 * width(alone)
    apart = [[Sample(s.blocks, policy=f"{i} {s.policy}") for s in c] for i, c in enumerate(cells)]
    assert width(stratified_bootstrap(apart)) < 0.5 * width(alone)


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


TRIALS = 300
MOST = stats.binom(TRIALS, 0.05).ppf(0.999)
"""0.05 and three standard errors of such a share."""


@pytest.mark.parametrize(
    ("statistic", "policies", "runs", "of_policies", "of_runs", "episodes"),
    [
        (mean, 1, 5, 0.3, 0.0, 0.3),
        (iqm, 1, 5, 0.3, 0.2, 0.0),
        (mean, 5, 1, 0.1, 0.1, 0.0),
        (iqm, 5, 1, 0.1, 0.1, 0.3),
        (mean, 5, 3, 0.0, 0.2, 0.0),
        (iqm, 5, 3, 0.2, 0.1, 0.3),
    ],
)
def test_the_interval_misses_the_truth_in_at_most_one_of_twenty(
    statistic: Callable[..., Array],
    policies: int,
    runs: int,
    of_policies: float,
    of_runs: float,
    episodes: float,
) -> None:
    """Differences of two agents over policies, runs of each, and 100 shared episodes.

    The standard deviations span those of the committed runs: between runs, between episodes
    (initial states that suit one of the agents), and what is left. With one policy the truth is its
    own effect, with several it is the mean over all policies, 0.
    """
    generator = np.random.default_rng(1)
    missed = 0
    for _ in range(TRIALS):
        effect = of_policies * generator.standard_normal((policies, 1, 1))
        table = effect + of_runs * generator.standard_normal((policies, runs, 1))
        table = table + 0.4 * generator.standard_normal((policies, runs, 100))
        table = table + episodes * generator.standard_normal(100)
        truth = float(effect[0, 0, 0]) if policies == 1 else 0.0
        found = crossed_bootstrap(by_policy(table), statistic, resamples=400)
        missed += not found.low <= truth <= found.high
    assert missed <= MOST


@pytest.mark.long
@pytest.mark.parametrize("policies", [5, 10])
@pytest.mark.parametrize(
    ("of_policies", "episodes"), [(0.0, 0.0), (0.0, 0.2), (0.04, 0.2), (0.1, 0.2), (0.3, 0.2)]
)
def test_what_lies_between_policy_and_episode_counts_once(
    policies: int, of_policies: float, episodes: float
) -> None:
    """Intervals have the truth in 93 to 97 % of 1,000 cases, up to chance.

    If single episodes of single policies counted twice, it would be 98 to 100 % where policies are
    alike.
    """
    generator, trials, missed = np.random.default_rng(2), 1000, 0
    for _ in range(trials):
        table = of_policies * generator.standard_normal((policies, 1, 1))
        table = table + 0.4 * generator.standard_normal((policies, 1, 100))
        table = table + episodes * generator.standard_normal(100)
        found = crossed_bootstrap(by_policy(table), resamples=400)
        missed += not found.low <= 0 <= found.high
    assert stats.binom(trials, 0.03).ppf(0.001) <= missed <= stats.binom(trials, 0.07).ppf(0.999)


def test_p_values_belong_to_the_intervals() -> None:
    generator = np.random.default_rng(5)
    draws = 0.1 + 0.1 * generator.standard_normal((40, 5, 1, 1))
    effects: list[Effect] = [cell_estimates([by_policy(d)], resamples=400)[0] for d in draws]
    effects += [ShareDifference((k, 12.0), (2.0, 12.0)) for k in range(13)]
    signs = [effect.interval().sign != 0 for effect in effects]
    assert [p_difference(effect) < 0.05 for effect in effects] == signs
    assert 5 < sum(signs) < len(signs) - 5
    inside = [max(map(abs, (i.low, i.high))) < 0.25 for i in (e.interval(0.9) for e in effects)]
    assert [p_equivalence(effect, 0.25) < 0.05 for effect in effects] == inside
    assert 5 < sum(inside) < len(inside) - 5
    assert p_equivalence(effects[0], 1e-9) == 1.0


def test_holm_by_hand() -> None:
    assert holm([0.01, 0.04, 0.03]) == pytest.approx([0.03, 0.06, 0.06])
    assert holm([0.5, 0.9]) == [1.0, 1.0]
    assert holm([]) == []


def nested_cells(policies: int, runs: int) -> list[list[Sample]]:
    """60 cells: policies differ by 0.3, runs by 0.2, episodes by 1, and so does what is left."""
    generator = np.random.default_rng(7)
    made = []
    for _ in range(60):
        table = 0.3 * generator.standard_normal((policies, 1, 1))
        table = table + 0.2 * generator.standard_normal((policies, runs, 1))
        table = table + generator.standard_normal(50)
        made.append(by_policy(table + generator.standard_normal((policies, runs, 50))))
    return made


def test_variance_components_of_a_nested_design() -> None:
    """Each is found where it is there, and not where only their sum is known."""
    full = spread(nested_cells(5, 3))
    assert (full.policies, full.runs) == pytest.approx((0.3, 0.2), abs=0.05)
    assert full.episodes == pytest.approx(np.sqrt(2 / 50), rel=0.1)
    one_run = spread(nested_cells(5, 1))
    assert one_run.together == pytest.approx(np.hypot(0.3, 0.2), abs=0.04)
    one_policy = spread(nested_cells(1, 5))
    assert one_policy.runs == pytest.approx(0.2, abs=0.03)
    unknown = full.together, one_run.policies, one_run.runs, one_policy.policies
    assert {*unknown, one_policy.together} == {None}
    # Copies of one evaluation differ in nothing.
    assert spread([by_policy(np.ones((3, 2, 4)))]).policies == 0


def test_the_bootstrap_repeats_and_needs_samples() -> None:
    samples = [of(np.random.default_rng(i).random(30)) for i in range(3)]
    assert crossed_bootstrap(samples) == crossed_bootstrap(samples)
    for bad in ([], [of([])], [of([1.0]), of([])]):
        with pytest.raises(ValueError, match=r"episode|without runs"):
            crossed_bootstrap(bad)


def test_success_stays_a_share() -> None:
    """Unanimous episodes get Wilson's interval."""
    rates = (100, 100, 99, 98, 60)
    interval = success_interval([of(np.repeat([0.0, 1.0], [100 - k, k])) for k in rates])
    assert 0 < interval.low < interval.value < interval.high == 1
    assert success_interval([of([1.0] * 50)] * 2) == Interval(1.0, *wilson(50, 50))
    assert success_interval([of([0.0] * 50)]) == Interval(0.0, *wilson(0, 50))


@pytest.mark.parametrize(
    ("steps", "values", "area"),
    [
        ([0, 100], [0.0, 1.0], 0.5),
        ([0, 50, 100], [0.0, 1.0, 1.0], 0.75),
        ([50], [0.4], 0.4),
        # Starts late and ends early: the ends are held.
        ([20, 60], [0.2, 0.6], 0.04 + 0.16 + 0.24),
        # What lies beyond the budget does not count.
        ([0, 200], [0.0, 1.0], 0.25),
    ],
)
def test_area_under_curve_is_linear(steps: list[int], values: list[float], area: float) -> None:
    assert area_under_curve(steps, values, 100) == pytest.approx(area)
    assert np.dot(area_weights(steps, 100), values) == pytest.approx(area)


def test_what_comes_before_the_first_update_does_not_count() -> None:
    """A line from 0 to 1: from step 20 on its mean height is 0.6."""
    assert area_under_curve([0, 100], [0.0, 1.0], 100, 20) == pytest.approx(0.6)
    assert area_under_curve([0, 50, 100], [0.0, 0.0, 1.0], 100, 50) == pytest.approx(0.5)
    assert sum(area_weights([0, 30, 100], 100, 50)) == pytest.approx(1.0)


def test_steps_to_threshold_and_their_median() -> None:
    assert steps_to_threshold([0, 10, 20], [0.1, 0.5, 0.6], 0.5) == 10
    assert steps_to_threshold([0, 10, 20], [0.9, 0.1, 0.5], 0.5) == 20
    assert steps_to_threshold([0, 10, 20], [0.9, 0.9, 0.4], 0.5) is None
    assert steps_to_threshold([0, 10, 20], [0.1, 0.5, 0.4], 0.6) is None
    assert censored_median([10, None, 30]) == 30
    assert censored_median([10, 20]) == 15
    assert censored_median([10, None]) is None
    assert censored_median([None, None, 5]) is None


def test_shares_have_their_textbook_intervals() -> None:
    """Wilson's, and Newcombe 1998, table II, method 10."""
    assert wilson(0, 10) == pytest.approx((0.0, 0.27753), abs=1e-5)
    assert wilson(81, 263) == pytest.approx((0.25527, 0.36621), abs=1e-4)
    textbook = {
        ((56, 70), (48, 80)): (0.2, 0.0524, 0.3339),
        ((9, 10), (3, 10)): (0.6, 0.1705, 0.8090),
        ((5, 56), (0, 29)): (0.0893, -0.0381, 0.1926),
        ((10, 10), (0, 10)): (1.0, 0.6075, 1.0),
    }
    for (first, second), (value, low, high) in textbook.items():
        found = ShareDifference(first, second).interval()
        assert (found.value, found.low, found.high) == pytest.approx((value, low, high), abs=5e-5)


def test_a_sample_weighs_its_blocks() -> None:
    first, second = of([0.0, 1.0]).blocks[0], of([1.0, 1.0, 0.0, 0.0], 10).blocks[0]
    sample = Sample((first, second), (0.25, 0.75))
    assert sample.value == pytest.approx(0.25 * 0.5 + 0.75 * 0.5)
    assert Sample.weighted([sample], [-1]).value == -sample.value
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
    # The same episodes in every cell are drawn once: they do not average out.
    shared = stratified_bootstrap([[of(np.repeat([0.0, 1.0], 25))] * 5] * 4)
    assert width(shared) == pytest.approx(width(crossed_bootstrap([of(np.repeat([0.0, 1.0], 25))])))
    with pytest.raises(ValueError, match="cell"):
        stratified_bootstrap([])


def on(policy: str, values: Iterable[float]) -> list[tuple[str, float]]:
    return [(policy, value) for value in values]


def test_probability_of_improvement_by_hand() -> None:
    # 3 beats 1, 2; ties with 3: 2.5 of 3. 1 ties with 1: 0.5 of 3. Together 3 of 6.
    cell = (on("a", [3, 1]), on("a", [1, 2, 3]))
    assert probability_of_improvement([cell]).value == pytest.approx(0.5)
    # The mean over cells, however many runs each has.
    mixed = (on("a", [1]), on("a", [0])), (on("a", [0, 0, 0]), on("a", [1, 1, 1]))
    assert probability_of_improvement(mixed).value == pytest.approx(0.5)
    # With one policy it is the Mann-Whitney statistic.
    generator = np.random.default_rng(2)
    x, y = generator.integers(0, 5, 9).tolist(), generator.integers(0, 5, 6).tolist()
    one = probability_of_improvement([(on("a", x), on("a", y))])
    assert one.value == pytest.approx(stats.mannwhitneyu(x, y).statistic / 54)
    assert one.low < one.value < one.high
    # Only runs on one policy are compared; policies count alike.
    policies = (on("a", [2]) + on("b", [5, 5]), on("a", [1]) + on("b", [9, 9]) + on("c", [0]))
    assert probability_of_improvement([policies]).value == pytest.approx(0.5)
    # Where one side always wins the interval is Wilson's: of runs, or of policies in three cells.
    sure = probability_of_improvement([(on("a", [2, 3]), on("a", [0, 1, 1]))])
    assert (sure.value, sure.low, sure.high) == (1.0, *wilson(2, 2))
    runs = [(f"policy {i}", 1.0) for i in range(5)]
    never = probability_of_improvement([([(p, 0.0) for p, _ in runs], runs)] * 3)
    assert (never.value, never.low, never.high) == (0.0, *wilson(0, 5))
    # Each of five policies agrees with the others in a cell, but cells differ.
    ones, zeros = ([(f"{p}", value) for p in range(5)] for value in (1.0, 0.0))
    mixed = probability_of_improvement([(ones, zeros), (ones, zeros), (zeros, ones)])
    assert (mixed.low, mixed.high) == pytest.approx(wilson(10 / 3, 5))
    for bad in ([], [([], on("a", [1]))], [(on("a", [1]), on("b", [1]))]):
        with pytest.raises(ValueError, match=r"no cell|runs of both"):
            probability_of_improvement(bad)


def test_performance_profiles_by_hand() -> None:
    cells = [on("a", [0.1, 0.5]), on("a", [0.5, 0.5, 0.9, 0.9])]
    share, low, high = performance_profile(cells, [0.0, 0.5, 0.6, 1.0])
    assert share == pytest.approx([1.0, 0.75, 0.25, 0.0])
    assert low[[0, 3]].tolist() == high[[0, 3]].tolist() == [1.0, 0.0]
    assert low[1] < 0.75 < high[1] == 1.0
    # Policies count alike, and a policy's runs are drawn together.
    uneven = [on("a", [1.0] * 9) + on("b", [0.0])]
    share, low, high = performance_profile(uneven, [0.5])
    assert (share, low, high) == ([0.5], [0.0], [1.0])
    with pytest.raises(ValueError, match="runs"):
        performance_profile([[]], [0.5])
