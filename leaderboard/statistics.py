"""Statistics of the leaderboard: aggregates, intervals and learning-curve summaries.

All functions are pure and seeded: the same numbers give the same result. Success is a share in
[0, 1], steps are environment control steps. docs/metrics.md states each formula.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.integrate import trapezoid

CONFIDENCE = 0.95
RESAMPLES = 5000

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
class Sample:
    """What one run contributes: a weighted sum of the means of one or more blocks of episodes.

    A success rate has one block of weight 1; an area under the learning curve has a block for each
    evaluation, weighted by the trapezoidal rule.
    """

    blocks: tuple[Array, ...]
    weights: tuple[float, ...]

    @classmethod
    def of(cls, values: Sequence[float] | Array | Self) -> Self:
        """One block of weight 1; a `Sample` is returned as it is."""
        if isinstance(values, cls):
            return values
        return cls((np.asarray(values, dtype=np.float64),), (1.0,))

    @cached_property
    def value(self) -> float:
        return sum(w * float(b.mean()) for w, b in zip(self.weights, self.blocks, strict=True))

    def draw(self, size: int, generator: np.random.Generator) -> Array:
        """`size` values, each from episodes drawn with replacement within every block."""
        total = np.zeros(size)
        for weight, block in zip(self.weights, self.blocks, strict=True):
            # Drawing episodes with replacement is drawing how often each distinct value occurs;
            # success has two of them, so this is far cheaper than drawing the episodes one by one.
            values, counts = np.unique(block, return_counts=True)
            occurrences = generator.multinomial(block.size, counts / block.size, size=size)
            # Not `@`: matrix products would start threads for these small sums.
            total += weight * (occurrences * values).sum(axis=1) / block.size
        return total


Runs = Sequence[Sequence[float] | Array | Sample]
"""One entry a run: its episodes, or a `Sample`."""


def iqm(values: Sequence[float] | Array, axis: int = -1) -> Array:
    """Interquartile mean: the mean without the lowest and highest quarter (Agarwal et al. 2021).

    Below 4 values nothing is cut off, so it is the plain mean.
    """
    return np.asarray(stats.trim_mean(np.asarray(values, dtype=np.float64), 0.25, axis=axis))


def mean(values: Sequence[float] | Array, axis: int = -1) -> Array:
    """The plain mean, in the form that `two_stage_bootstrap` expects of a statistic."""
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


def bootstrap_draws(
    samples: Runs,
    generator: np.random.Generator,
    statistic: Callable[..., Array] = mean,
    resamples: int = RESAMPLES,
) -> Array:
    """Draws of `statistic` over runs: [resamples].

    Each resample draws runs with replacement, then episodes with replacement within each drawn
    run, and applies `statistic` to the runs' values. It therefore covers the spread over seeds and
    the noise of finitely many episodes; with one run only the latter is left. It errs on the wide
    side, which makes up for the narrow bootstrap of very few seeds.

    Raises ValueError without samples.
    """
    runs = [Sample.of(sample) for sample in samples]
    if not runs or any(block.size == 0 for run in runs for block in run.blocks):
        raise ValueError("every run needs at least one episode")
    drawn = generator.integers(len(runs), size=(resamples, len(runs)))
    values = np.empty(drawn.shape)
    for index, run in enumerate(runs):
        chosen = drawn == index
        values[chosen] = run.draw(int(chosen.sum()), generator)
    return statistic(values, axis=1)


def two_stage_bootstrap(
    samples: Runs,
    statistic: Callable[..., Array] = mean,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Interval:
    """`statistic` over runs with the percentile interval of `bootstrap_draws`."""
    draws = bootstrap_draws(samples, np.random.default_rng(seed), statistic, resamples)
    values = [Sample.of(sample).value for sample in samples]
    return percentile(float(statistic(values, axis=0)), draws)


def stratified_bootstrap(
    cells: Sequence[Runs], resamples: int = RESAMPLES, seed: int = 0
) -> Interval:
    """Mean over cells of the mean over their runs; runs and episodes are drawn within each cell.

    The cells themselves are not drawn: the interval is about these cells. Raises ValueError
    without cells.
    """
    if not cells:
        raise ValueError("there is no cell")
    generator = np.random.default_rng(seed)
    draws = np.mean([bootstrap_draws(runs, generator, mean, resamples) for runs in cells], axis=0)
    value = np.mean([np.mean([Sample.of(run).value for run in runs]) for runs in cells])
    return percentile(float(value), draws)


def success_interval(samples: Runs, resamples: int = RESAMPLES) -> Interval:
    """IQM over runs of the success rate with its two-stage bootstrap interval.

    Where all episodes agree (all failed or all succeeded) the bootstrap has no width; Wilson's
    interval of the pooled episodes takes its place.
    """
    pooled = np.concatenate([block for sample in samples for block in Sample.of(sample).blocks])
    result = two_stage_bootstrap(samples, iqm, resamples)
    if np.ptp(pooled) == 0:
        low, high = wilson(int(pooled.sum()), pooled.size)
        return Interval(result.value, low, high)
    return result


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


def paired_differences(first: Mapping[Key, float], second: Mapping[Key, float]) -> Array:
    """`first - second` on the episodes that both have, in no particular order."""
    return np.array([value - second[key] for key, value in first.items() if key in second])


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

    Not of the first one above it: an untrained actor steers with about zero noise, which often is
    good; what counts is when the agent has got over what learning does to that.
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
