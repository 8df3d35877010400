"""Statistics of the leaderboard: aggregates, intervals and learning-curve summaries.

All functions are pure and seeded: the same numbers give the same result. Success is a share in
[0, 1], steps are environment control steps. docs/metrics.md states each formula.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.integrate import trapezoid

CONFIDENCE = 0.95
RESAMPLES = 5000
FINAL_WINDOW = 0.2
"""The final window is the last fifth of the budget."""

Array = NDArray[np.float64]


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


def two_stage_bootstrap(
    samples: Sequence[Sequence[float] | Array],
    statistic: Callable[..., Array] = mean,
    resamples: int = RESAMPLES,
    seed: int = 0,
) -> Interval:
    """Percentile interval of `statistic` over seeds, for `samples[seed] = values of its episodes`.

    Each resample draws seeds with replacement, then episodes with replacement within each drawn
    seed, and applies `statistic` to the seeds' means. It therefore covers the spread over seeds and
    the noise of finitely many episodes; with one seed only the latter is left. It errs on the wide
    side, which makes up for the narrow bootstrap of very few seeds.

    Raises ValueError without samples.
    """
    groups = [np.asarray(sample, dtype=np.float64) for sample in samples]
    if not groups or any(group.size == 0 for group in groups):
        raise ValueError("every seed needs at least one episode")
    generator = np.random.default_rng(seed)
    drawn = generator.integers(len(groups), size=(resamples, len(groups)))
    means = np.empty(drawn.shape)
    for index, group in enumerate(groups):
        chosen = drawn == index
        # Drawing episodes with replacement is drawing how often each distinct value occurs; success
        # has two of them, so this is far cheaper than drawing the episodes one by one.
        values, counts = np.unique(group, return_counts=True)
        occurrences = generator.multinomial(group.size, counts / group.size, size=int(chosen.sum()))
        means[chosen] = occurrences @ values / group.size
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(statistic(means, axis=1), (tail, 1 - tail))
    value = float(statistic(np.array([group.mean() for group in groups]), axis=0))
    return Interval(value, float(low), float(high))


def success_interval(
    samples: Sequence[Sequence[float] | Array], resamples: int = RESAMPLES
) -> Interval:
    """IQM over seeds of the success rate with its two-stage bootstrap interval.

    Where all episodes agree (all failed or all succeeded) the bootstrap has no width; Wilson's
    interval of the pooled episodes takes its place.
    """
    pooled = np.concatenate([np.asarray(sample, dtype=np.float64) for sample in samples])
    result = two_stage_bootstrap(samples, iqm, resamples)
    if np.ptp(pooled) == 0:
        low, high = wilson(int(pooled.sum()), pooled.size)
        return Interval(result.value, low, high)
    return result


def paired_differences(first: Mapping[int, float], second: Mapping[int, float]) -> Array:
    """`first - second` on the episode seeds that both have, in the order of the seeds."""
    return np.array([first[seed] - second[seed] for seed in sorted(first.keys() & second.keys())])


def area_under_curve(steps: Sequence[int], values: Sequence[float], budget: int) -> float:
    """Area under a learning curve by the trapezoidal rule, as a share of `budget` x 1.

    The first value is held back to step 0 and the last one on to the budget; what lies beyond the
    budget is left out. One evaluation gives its own value.
    """
    knots = np.array([0, *steps, max(budget, steps[-1])], dtype=np.float64)
    heights = np.array([values[0], *values, values[-1]], dtype=np.float64)
    inside = np.unique(np.concatenate([knots[knots <= budget], [float(budget)]]))
    return float(trapezoid(np.interp(inside, knots, heights), inside) / budget)


def steps_to_threshold(
    steps: Sequence[int], values: Sequence[float], threshold: float
) -> int | None:
    """Steps of the first evaluation at or above `threshold`; None (censored) if there is none."""
    return next((s for s, v in zip(steps, values, strict=True) if v >= threshold), None)


def censored_median(values: Sequence[int | None]) -> float | None:
    """Median where None counts as later than everything; None if the median itself is censored."""
    result = float(np.median([np.inf if value is None else value for value in values]))
    return result if np.isfinite(result) else None


def deepest_dip(values: Sequence[float], base: float) -> float:
    """How far the lowest evaluation lies below the base: a number <= 0, and 0 if never below."""
    return float(min(0.0, min(values) - base))


def final_window_mean(steps: Sequence[int], values: Sequence[float], budget: int) -> float:
    """Mean of the evaluations in the last fifth of the budget, at least of the last one."""
    start = (1 - FINAL_WINDOW) * budget
    window = [v for s, v in zip(steps, values, strict=True) if s >= start] or [values[-1]]
    return float(np.mean(window))
