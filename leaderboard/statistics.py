"""Statistics of the leaderboard: aggregates, intervals and learning-curve summaries.

All functions are pure and seeded: the same numbers give the same result. Success is a share in
[0, 1], steps are environment control steps. docs/metrics.md states each formula.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.integrate import trapezoid

CONFIDENCE = 0.95
RESAMPLES = 5000
_EPISODES = 1
"""Separates the stream of episode weights from other generators with small seeds."""

Array = NDArray[np.float64]
Key = TypeVar("Key", bound=Hashable)


@dataclass(frozen=True)
class Interval:
    """A point estimate with its 95 % interval."""

    value: float
    low: float
    high: float

    @property
    def sign(self) -> int:
        """+1 or -1 where the interval lies on one side of zero, else 0."""
        return int(self.low > 0) - int(self.high < 0)


@dataclass(frozen=True)
class Block:
    """Episodes of one run, each measured in one or more evaluations.

    Entry i of each belongs to the episode with the seed `seeds[i]`: the sum of its values and how
    many these are. The block's value is the mean over all of them.
    """

    seeds: tuple[int, ...]
    totals: Array
    counts: Array

    @property
    def value(self) -> float:
        return float(self.totals.sum() / self.counts.sum())

    def draw(self, resamples: int) -> Array:
        """The value under each resample's weights of episodes: [resamples]."""
        totals = _weighted_sum(self.seeds, tuple(self.totals), resamples)
        return totals / _weighted_counts(self.seeds, tuple(self.counts), resamples)


@dataclass(frozen=True)
class Sample:
    """What one run contributes: a weighted sum of the values of one or more blocks of episodes.

    A success rate has one block of weight 1; an area under the learning curve has a block for each
    evaluation, weighted by the trapezoidal rule.
    """

    blocks: tuple[Block, ...]
    weights: tuple[float, ...] = (1.0,)

    @classmethod
    def pooled(cls, values: Iterable[tuple[int, float]]) -> Self:
        """One block of (episode seed, value) pairs; a seed may occur in several evaluations."""
        gathered: dict[int, list[float]] = defaultdict(list)
        for seed, value in values:
            gathered[seed].append(value)
        totals = np.array([sum(gathered[seed]) for seed in gathered], dtype=np.float64)
        counts = np.array([len(gathered[seed]) for seed in gathered], dtype=np.float64)
        return cls((Block(tuple(gathered), totals, counts),))

    @classmethod
    def constant(cls, value: float) -> Self:
        """One number for the whole run, equal in every resample."""
        return cls.pooled([(0, value)])

    @cached_property
    def value(self) -> float:
        return sum(w * b.value for w, b in zip(self.weights, self.blocks, strict=True))

    def draw(self, resamples: int) -> Array:
        """The value under each resample's weights of episodes: [resamples]."""
        blocks = zip(self.weights, self.blocks, strict=True)
        return np.sum([weight * block.draw(resamples) for weight, block in blocks], axis=0)

    def negated(self) -> Self:
        return replace(self, weights=tuple(-weight for weight in self.weights))


@lru_cache(maxsize=512)
def episode_weights(seed: int, resamples: int) -> Array:
    """How much the episode with this seed weighs in each resample: exponential draws of mean 1.

    They depend on the seed only, so that an episode has the same weight in all runs, evaluations
    and cells: agents are scored on the same initial states, and a hard one is hard for all of them.
    With weights instead of counts (the Bayesian bootstrap, Rubin 1981) no block is ever empty.
    """
    weights = np.random.default_rng([_EPISODES, seed]).exponential(size=resamples)
    weights.flags.writeable = False
    return weights


@lru_cache(maxsize=4)
def _stacked_weights(seeds: tuple[int, ...], resamples: int) -> Array:
    """`episode_weights` of several episodes: [seeds, resamples]."""
    return np.stack([episode_weights(seed, resamples) for seed in seeds])


def _weighted_sum(seeds: tuple[int, ...], values: tuple[float, ...], resamples: int) -> Array:
    # Not `@`: matrix products would start threads for these small sums.
    return (_stacked_weights(seeds, resamples) * np.array(values)[:, None]).sum(axis=0)


_weighted_counts = lru_cache(maxsize=64)(_weighted_sum)
"""The same, kept: most blocks of a leaderboard have equal episodes and counts."""


def iqm(values: Sequence[float] | Array, axis: int = -1) -> Array:
    """Interquartile mean: the mean without the lowest and highest quarter (Agarwal et al. 2021).

    Below 4 values nothing is cut off, so it is the plain mean.
    """
    return np.asarray(stats.trim_mean(np.asarray(values, dtype=np.float64), 0.25, axis=axis))


def mean(values: Sequence[float] | Array, axis: int = -1) -> Array:
    """The plain mean, in the form that the bootstraps expect of a statistic."""
    return np.asarray(np.mean(np.asarray(values, dtype=np.float64), axis=axis))


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """Wilson's 95 % interval of a success probability."""
    interval = stats.binomtest(successes, trials).proportion_ci(CONFIDENCE, method="wilson")
    return float(interval.low), float(interval.high)


def newcombe(first: tuple[int, int], second: tuple[int, int]) -> Interval:
    """Difference of two proportions, each (successes, trials), with Newcombe's hybrid interval.

    Combines the two Wilson intervals (Newcombe 1998, method 10); unlike a bootstrap it has a width
    when nobody or everybody succeeds.
    """
    p, q = first[0] / first[1], second[0] / second[1]
    (p_low, p_high), (q_low, q_high) = wilson(*first), wilson(*second)
    low = p - q - float(np.hypot(p - p_low, q_high - q))
    high = p - q + float(np.hypot(p_high - p, q - q_low))
    return Interval(p - q, low, high)


def percentile(value: float, draws: Array) -> Interval:
    """`value` with the 95 % percentile interval of its bootstrap draws."""
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(draws, (tail, 1 - tail))
    return Interval(float(value), float(low), float(high))


def small_sample_factor(runs: int, freedom: int) -> float:
    """By how much a percentile bootstrap over `runs` runs is too narrow.

    Its variance has the divisor n, not n - 1, and its tails are those of a normal distribution, not
    of Student's with `freedom` degrees of freedom (Hesterberg 2015, The American Statistician 69).
    1.58 for five runs of one cell.
    """
    quantile = (1 + CONFIDENCE) / 2
    tails = stats.t.ppf(quantile, freedom) / stats.norm.ppf(quantile)
    return float(tails * np.sqrt(runs / (runs - 1)))


def bootstrap_draws(
    samples: Sequence[Sample],
    generator: np.random.Generator,
    statistic: Callable[..., Array] = mean,
    resamples: int = RESAMPLES,
    freedom: int | None = None,
) -> Array:
    """Draws of `statistic` over runs whose quantiles are its interval: [resamples].

    Runs and episodes are crossed factors: every run is scored on the same initial states. Each
    resample weighs the episodes (`episode_weights`, the same for all runs) and draws runs with
    replacement (Owen and Eckles 2012); what the drawn runs change is widened by
    `small_sample_factor`. With one run only episodes vary.

    `freedom` is the number of degrees of freedom, runs - 1 if these are all there are.

    Raises ValueError without samples.
    """
    if not samples or any(not block.seeds for run in samples for block in run.blocks):
        raise ValueError("every run needs at least one episode")
    number = len(samples)
    values = np.stack([sample.draw(resamples) for sample in samples], axis=1)
    of_all = statistic(values, axis=1)
    if number == 1:
        return of_all
    drawn = generator.integers(number, size=(resamples, number))
    of_drawn = statistic(np.take_along_axis(values, drawn, axis=1), axis=1)
    factor = small_sample_factor(number, number - 1 if freedom is None else freedom)
    return of_all + factor * (of_drawn - of_all)


def crossed_bootstrap(
    samples: Sequence[Sample],
    statistic: Callable[..., Array] = mean,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Interval:
    """`statistic` over runs with the 95 % interval of `bootstrap_draws`."""
    draws = bootstrap_draws(samples, np.random.default_rng(seed), statistic, resamples)
    return percentile(float(statistic([sample.value for sample in samples], axis=0)), draws)


def stratified_draws(
    cells: Sequence[Sequence[Sample]],
    generator: np.random.Generator,
    resamples: int = RESAMPLES,
) -> Array:
    """Draws of the mean over runs of every cell: [cells, resamples].

    Runs are drawn within each cell, episodes for all cells at once. Raises ValueError without
    cells.
    """
    if not cells:
        raise ValueError("there is no cell")
    freedom = sum(len(runs) - 1 for runs in cells)
    return np.stack([bootstrap_draws(c, generator, mean, resamples, freedom) for c in cells])


def stratified_bootstrap(
    cells: Sequence[Sequence[Sample]], resamples: int = RESAMPLES, seed: int = 0
) -> Interval:
    """Mean over cells of the mean over their runs, with the interval of `stratified_draws`.

    The cells themselves are not drawn: the interval is about these cells. Raises ValueError
    without cells.
    """
    draws = stratified_draws(cells, np.random.default_rng(seed), resamples).mean(axis=0)
    value = np.mean([np.mean([run.value for run in runs]) for runs in cells])
    return percentile(float(value), draws)


def success_interval(samples: Sequence[Sample], resamples: int = RESAMPLES) -> Interval:
    """IQM over runs of the success rate with its interval, which stays within [0, 1].

    Where all episodes agree (all failed or all succeeded) the bootstrap has no width; Wilson's
    interval of the distinct episodes takes its place.
    """
    result = crossed_bootstrap(samples, iqm, resamples)
    if len(set(values := [run.value for run in samples])) == 1 and values[0] in (0.0, 1.0):
        episodes = len({seed for run in samples for block in run.blocks for seed in block.seeds})
        return Interval(result.value, *wilson(round(values[0] * episodes), episodes))
    return Interval(result.value, max(0.0, result.low), min(1.0, result.high))


def probability_of_improvement(
    cells: Sequence[tuple[Sequence[float], Sequence[float]]],
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Interval:
    """P(X > Y) + P(X = Y) / 2 for a run of either agent, mean over cells (Agarwal et al. 2021).

    `cells` holds (values of X's runs, values of Y's runs). Within a cell it is the Mann-Whitney
    statistic over all pairs of runs. The interval draws the runs of both with replacement within
    each cell. Raises ValueError without cells or for a cell without runs.
    """
    if not cells or any(len(x) == 0 or len(y) == 0 for x, y in cells):
        raise ValueError("every cell needs runs of both agents")
    generator = np.random.default_rng(seed)
    value, draws = 0.0, np.zeros(resamples)
    for x, y in cells:
        difference = np.subtract.outer(np.asarray(x, float), np.asarray(y, float))
        wins = (np.sign(difference) + 1) / 2
        drawn_x = _occurrences(len(x), resamples, generator) / len(x)
        drawn_y = _occurrences(len(y), resamples, generator) / len(y)
        value += float(wins.mean()) / len(cells)
        draws += np.einsum("ri,ij,rj->r", drawn_x, wins, drawn_y) / len(cells)
    return percentile(value, draws)


def performance_profile(
    cells: Sequence[Sequence[float]],
    thresholds: Sequence[float] | Array,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> tuple[Array, Array, Array]:
    """Share of runs with a value >= each threshold, mean over cells: (share, low, high).

    The pointwise 95 % band draws runs with replacement within each cell. Raises ValueError without
    cells or for a cell without runs.
    """
    if not cells or any(len(values) == 0 for values in cells):
        raise ValueError("every cell needs runs")
    generator = np.random.default_rng(seed)
    levels = np.asarray(thresholds, dtype=np.float64)
    share, draws = np.zeros(levels.size), np.zeros((resamples, levels.size))
    for values in cells:
        reached = (np.asarray(values, float)[:, None] >= levels).astype(np.float64)
        drawn = _occurrences(len(values), resamples, generator) / len(values)
        share += reached.mean(axis=0) / len(cells)
        draws += np.einsum("ri,it->rt", drawn, reached) / len(cells)
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(draws, (tail, 1 - tail), axis=0)
    return share, low, high


def _occurrences(number: int, resamples: int, generator: np.random.Generator) -> Array:
    """How often each of `number` runs occurs in each resample: [resamples, number]."""
    return generator.multinomial(number, np.full(number, 1 / number), size=resamples).astype(float)


def paired_differences(first: Mapping[Key, float], second: Mapping[Key, float]) -> dict[Key, float]:
    """`first - second` for the keys (episodes) that both have."""
    return {key: value - second[key] for key, value in first.items() if key in second}


def area_under_curve(steps: Sequence[int], values: Sequence[float], budget: int) -> float:
    """Area under a learning curve by the trapezoidal rule, as a share of `budget` x 1.

    The first value is held back to step 0 and the last one on to the budget; what lies beyond the
    budget is left out. One evaluation gives its own value.
    """
    knots = np.array([0, *steps, max(budget, steps[-1])], dtype=np.float64)
    heights = np.array([values[0], *values, values[-1]], dtype=np.float64)
    inside = np.unique(np.concatenate([knots[knots <= budget], [float(budget)]]))
    return float(trapezoid(np.interp(inside, knots, heights), inside) / budget)


def area_weights(steps: Sequence[int], budget: int) -> tuple[float, ...]:
    """What each evaluation weighs in `area_under_curve`, which is linear in the values."""
    return tuple(area_under_curve(steps, list(unit), budget) for unit in np.eye(len(steps)))


def steps_to_threshold(
    steps: Sequence[int], values: Sequence[float], threshold: float
) -> int | None:
    """Steps of the evaluation from which on all are at or above `threshold`; None (censored) if
    the last one is below.

    The first evaluation above it does not count: an untrained actor steers with about zero noise,
    which is often good until learning makes it worse for a while.
    """
    reached = None
    for step, value in zip(steps, values, strict=True):
        if value < threshold:
            reached = None
        elif reached is None:
            reached = step
    return reached


def censored_median(values: Sequence[int | None]) -> float | None:
    """Median where None counts as later than everything; None if the median itself is censored."""
    result = float(np.median([np.inf if value is None else value for value in values]))
    return result if np.isfinite(result) else None


def deepest_dip(differences: Sequence[float]) -> float:
    """Lowest of the differences to the base over a run's evaluations; 0 if never below it."""
    return float(min(0.0, *differences))
