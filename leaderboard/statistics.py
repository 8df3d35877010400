"""Statistics of the leaderboard: aggregates, intervals and learning-curve summaries.

All functions are pure and seeded: the same numbers give the same result. Success is a share in
[0, 1], steps are environment control steps. docs/metrics.md states each formula.
"""

from __future__ import annotations

import hashlib
import math
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Protocol, Self, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy import special, stats

from symsteer.leaderboard.records.measures import (
    CONFIDENCE,
    area_under_curve,
    newcombe,
    normal_quantile,
    wilson,
)

RESAMPLES = 5000
_EPISODES, _UNITS = 1, 2
"""Separate the streams of weights from each other and from generators with small seeds."""

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
class EpisodeBlock:
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
        return totals / _weighted_sum(self.seeds, tuple(self.counts), resamples)


@dataclass(frozen=True)
class Sample:
    """What one run contributes: a weighted sum of the values of one or more blocks of episodes.

    A success rate has one block of weight 1; an area under the learning curve has a block for each
    evaluation, weighted by the trapezoidal rule.
    """

    blocks: tuple[EpisodeBlock, ...]
    weights: tuple[float, ...] = (1.0,)
    policy: str = ""
    """Content hash of the base policy that the run steers."""

    @classmethod
    def pooled(cls, values: Iterable[tuple[int, float]], policy: str = "") -> Self:
        """One block of (episode seed, value) pairs; a seed may occur in several evaluations."""
        gathered: dict[int, list[float]] = defaultdict(list)
        for seed, value in values:
            gathered[seed].append(value)
        totals = np.array([sum(gathered[seed]) for seed in gathered], dtype=np.float64)
        counts = np.array([len(gathered[seed]) for seed in gathered], dtype=np.float64)
        return cls((EpisodeBlock(tuple(gathered), totals, counts),), policy=policy)

    @classmethod
    def constant(cls, value: float, policy: str = "") -> Self:
        """One number for the whole run, equal in every resample."""
        return cls.pooled([(0, value)], policy)

    @classmethod
    def weighted(cls, samples: Sequence[Self], factors: Iterable[float]) -> Self:
        """The sum of samples on one base policy, each times its factor."""
        blocks = tuple(block for sample in samples for block in sample.blocks)
        pairs = zip(factors, samples, strict=True)
        weights = tuple(float(f) * weight for f, sample in pairs for weight in sample.weights)
        return cls(blocks, weights, samples[0].policy)

    @classmethod
    def mean(cls, runs: Sequence[Self]) -> Self:
        """The mean over runs on one base policy."""
        return cls.weighted(runs, [1 / len(runs)] * len(runs))

    @cached_property
    def value(self) -> float:
        return sum(w * b.value for w, b in zip(self.weights, self.blocks, strict=True))

    def draw(self, resamples: int) -> Array:
        """The value under each resample's weights of episodes: [resamples]."""
        blocks = zip(self.weights, self.blocks, strict=True)
        return np.sum([weight * block.draw(resamples) for weight, block in blocks], axis=0)


@lru_cache(maxsize=512)
def episode_weights(seed: int, resamples: int) -> Array:
    """How much the episode with this seed weighs in each resample: exponential draws of mean 1.

    They depend on the seed only, so that an episode has the same weight in all runs, evaluations
    and cells: agents are scored on the same initial states, and a hard one is hard for all of them.
    With weights instead of counts (the Bayesian bootstrap, Rubin 1981) no block is ever empty.
    """
    return _exponential([_EPISODES, seed], resamples)


@lru_cache(maxsize=512)
def unit_weights(unit: str, resamples: int) -> Array:
    """How much a base policy, or another unit with this name, weighs in each resample.

    They depend on the name only, so that a base policy has the same weight in all cells: the policy
    of a task is steered in several variants, and what it can do it can do in all of them.
    """
    digest = hashlib.sha256(unit.encode()).digest()
    return _exponential([_UNITS, int.from_bytes(digest[:8])], resamples)


def _exponential(seed: list[int], resamples: int) -> Array:
    weights = np.random.default_rng(seed).exponential(size=resamples)
    weights.flags.writeable = False
    return weights


@lru_cache(maxsize=4)
def _stacked_weights(seeds: tuple[int, ...], resamples: int) -> Array:
    """`episode_weights` of several episodes: [seeds, resamples]."""
    return np.stack([episode_weights(seed, resamples) for seed in seeds])


@lru_cache(maxsize=1024)
def _weighted_sum(seeds: tuple[int, ...], values: tuple[float, ...], resamples: int) -> Array:
    # Kept, because the sections of a leaderboard draw the same samples, and most have equal counts.
    # Not `@`: matrix products would start threads for these small sums.
    return np.einsum("er,e->r", _stacked_weights(seeds, resamples), np.array(values))


def iqm(values: Sequence[float] | Array, weights: Array | None = None) -> Array:
    """Interquartile mean: the mean without the lowest and highest quarter (Agarwal et al. 2021).

    Along the last axis. Below 4 values nothing is cut off, so it is the plain mean. With weights of
    the values, as many of n are cut off in weight as without them in number: floor(n / 4) / n of
    all weight at each end.
    """
    values = np.asarray(values, dtype=np.float64)
    if weights is None:
        return np.asarray(stats.trim_mean(values, 0.25, axis=-1))
    order = np.argsort(values, axis=-1)
    upto = np.cumsum(np.take_along_axis(weights, order, axis=-1), axis=-1)
    cut = values.shape[-1] // 4 / values.shape[-1]
    upto = np.clip(upto / upto[..., -1:], cut, 1 - cut)
    kept = np.diff(upto, axis=-1, prepend=cut) / (1 - 2 * cut)
    return np.asarray((kept * np.take_along_axis(values, order, axis=-1)).sum(axis=-1))


def mean(values: Sequence[float] | Array, weights: Array | None = None) -> Array:
    """The mean along the last axis, in the form that the bootstraps expect of a statistic."""
    return np.asarray(np.average(np.asarray(values, dtype=np.float64), axis=-1, weights=weights))


def percentile(value: float, draws: Array, confidence: float = CONFIDENCE) -> Interval:
    """`value` with the percentile interval of its bootstrap draws."""
    tail = (1 - confidence) / 2
    low, high = np.quantile(draws, (tail, 1 - tail))
    return Interval(float(value), float(low), float(high))


def tails(confidence: float, freedom: float) -> float:
    """By how much Student's tails are longer than those of a normal distribution; 1.42 for five."""
    if freedom == 0:
        return 1.0
    return float(special.stdtrit(freedom, (1 + confidence) / 2)) / normal_quantile(confidence)


class Effect(Protocol):
    """An estimate whose interval can be asked for at every level of confidence."""

    @property
    def value(self) -> float: ...

    def interval(self, confidence: float = CONFIDENCE) -> Interval: ...


@dataclass(frozen=True)
class BootstrapEstimate:
    """A bootstrapped estimate.

    Attributes:
        value: the estimate.
        episodes: under each resample's weights of episodes, with every unit as it is [resamples].
        units: what drawing units changes, with the variance of a mean over them [resamples].
        freedom: degrees of freedom of the units.
        residual: the variance that both have: that of single episodes of single units.
    """

    value: float
    episodes: Array
    units: Array
    freedom: int
    residual: float = 0.0

    def draws(self, confidence: float = CONFIDENCE) -> Array:
        """Draws whose quantiles are the ends of the interval: [resamples].

        The residual counts once. What is known of a variance is that of the units, whose degrees of
        freedom are few (Satterthwaite 1946).
        """
        of_episodes, of_units = float(self.episodes.var()), float(self.units.var())
        if of_units == 0:
            return self.episodes
        both = of_episodes + of_units
        once = both - min(self.residual, of_episodes, of_units)
        longer = tails(confidence, self.freedom * (once / of_units) ** 2)
        drawn = self.episodes - self.value + self.units
        return self.value + longer * math.sqrt(once / both) * drawn

    def interval(self, confidence: float = CONFIDENCE) -> Interval:
        return percentile(self.value, self.draws(confidence), confidence)


@dataclass(frozen=True)
class ShareDifference:
    """Difference of two shares, each (successes, trials), with Newcombe's hybrid interval.

    Where successes come in clusters, give the number of clusters as trials and the sum of the
    clusters' shares as successes: a share of a cluster varies at most as much as a single success.
    """

    first: tuple[float, float]
    second: tuple[float, float]

    @property
    def value(self) -> float:
        return self.first[0] / self.first[1] - self.second[0] / self.second[1]

    def interval(self, confidence: float = CONFIDENCE) -> Interval:
        return Interval(self.value, *newcombe(self.first, self.second, confidence))


def p_difference(effect: Effect) -> float:
    """The p-value of "there is no effect", two-sided: 1 - the most confidence of an interval that
    excludes 0.

    It is below 0.05 where the 95 % interval excludes 0, and nowhere else.
    """
    return _smallest(lambda p: effect.interval(1 - p).sign != 0, 1.0)


def p_equivalence(effect: Effect, margin: float) -> float:
    """The p-value of "the effect is at least `margin`, up or down", by two one-sided tests.

    That is the smallest p for which the interval of confidence 1 - 2 p lies between -`margin` and
    `margin` (Schuirmann 1987; 1 if there is none below 0.5).
    """

    def inside(p: float) -> bool:
        interval = effect.interval(1 - 2 * p)
        return -margin < interval.low and interval.high < margin

    smallest = _smallest(inside, 0.5)
    return smallest if smallest < 0.5 else 1.0


def _smallest(holds: Callable[[float], bool], largest: float) -> float:
    """The smallest p in (1e-6, `largest`) for which a test that only gets easier with p holds."""
    low, high = np.log(1e-6), np.log(largest)
    for _ in range(24):
        middle = (low + high) / 2
        low, high = (low, middle) if holds(float(np.exp(middle))) else (middle, high)
    return float(np.exp(high))


def holm(values: Sequence[float]) -> list[float]:
    """p-values of a family, adjusted so that at most one family in twenty has a false result below
    0.05 (Holm 1979)."""
    adjusted, largest = [0.0] * len(values), 0.0
    for rank, index in enumerate(sorted(range(len(values)), key=lambda i: values[i])):
        largest = max(largest, min(1.0, (len(values) - rank) * values[index]))
        adjusted[index] = largest
    return adjusted


def units_of(runs: Sequence[Sample], cell: object = "") -> dict[str, Sample]:
    """What is drawn of a cell, by name: its base policies, or the runs if there is one policy.

    A policy's runs are averaged and drawn together: their spread is a part of the spread of the
    policies' means, and to draw them again would count it twice (Davison and Hinkley 1997, section
    3.8).
    """
    policies: dict[str, list[Sample]] = defaultdict(list)
    for run in runs:
        policies[run.policy].append(run)
    if len(policies) == 1:
        return {f"{cell} {index}": run for index, run in enumerate(runs)}
    return {policy: Sample.mean(policies[policy]) for policy in sorted(policies)}


def cell_estimates(
    cells: Sequence[Sequence[Sample]],
    statistic: Callable[..., Array] = mean,
    resamples: int = RESAMPLES,
) -> list[BootstrapEstimate]:
    """`statistic` over the units (`units_of`) of each cell, all drawn together.

    Units and episodes are crossed factors: every run is scored on the same initial states. Each
    resample weighs the episodes (`episode_weights`) and the units (`unit_weights`), each the same
    wherever it occurs (Owen and Eckles 2012), one at a time. The weights of n units give a mean
    (n - 1) / (n + 1) of the variance that it has; what they change is scaled by the root of that.
    With one unit only episodes vary.

    Raises ValueError without cells, or for a run without episodes.
    """
    if not cells or not all(cells):
        raise ValueError("there is no cell, or one without runs")
    if any(not block.seeds for runs in cells for run in runs for block in run.blocks):
        raise ValueError("every run needs at least one episode")
    named = [units_of(runs, index) for index, runs in enumerate(cells)]
    freedom = degrees_of_freedom(named)
    estimates = []
    for units in named:
        number = len(units)
        values = np.stack([unit.draw(resamples) for unit in units.values()], axis=1)
        actual = np.array([unit.value for unit in units.values()])
        value, change, residual = float(statistic(actual)), np.zeros(resamples), 0.0
        if number > 1:
            weights = np.stack([unit_weights(unit, resamples) for unit in units], axis=1)
            change = statistic(np.broadcast_to(actual, weights.shape), weights) - value
            change *= np.sqrt((number + 1) / (number - 1))
            # Of the variance that episodes give to a unit, the part that no other unit shares.
            apart = values.var(axis=0).mean() - values.mean(axis=1).var()
            residual = max(0.0, float(apart) / (number - 1))
        estimates.append(BootstrapEstimate(value, statistic(values), change, freedom, residual))
    return estimates


def degrees_of_freedom(cells: Iterable[Iterable[str]]) -> int:
    """Number of units less one for each group of cells that share any."""
    groups: list[set[str]] = []
    for units in map(set, cells):
        joined = [group for group in groups if group & units]
        groups = [group for group in groups if not group & units]
        groups.append(units.union(*joined))
    return sum(len(group) - 1 for group in groups)


def combined(
    cells: Sequence[BootstrapEstimate], weights: Sequence[float] | None = None
) -> BootstrapEstimate:
    """A weighted sum of estimates that were drawn together; by default their mean.

    The cells themselves are not drawn: the interval is about these cells.
    """
    factors = np.full(len(cells), 1 / len(cells)) if weights is None else np.asarray(weights)
    return BootstrapEstimate(
        float(sum(f * cell.value for f, cell in zip(factors, cells, strict=True))),
        np.sum([f * cell.episodes for f, cell in zip(factors, cells, strict=True)], axis=0),
        np.sum([f * cell.units for f, cell in zip(factors, cells, strict=True)], axis=0),
        cells[0].freedom,
        float(sum(f**2 * cell.residual for f, cell in zip(factors, cells, strict=True))),
    )


def crossed_bootstrap(
    runs: Sequence[Sample], statistic: Callable[..., Array] = mean, resamples: int = RESAMPLES
) -> Interval:
    """`statistic` over the units of one cell with its 95 % interval (`cell_estimates`)."""
    return cell_estimates([runs], statistic, resamples)[0].interval()


def stratified_bootstrap(cells: Sequence[Sequence[Sample]], resamples: int = RESAMPLES) -> Interval:
    """Mean over cells of the mean over their units, with its 95 % interval (`combined`)."""
    return combined(cell_estimates(cells, mean, resamples)).interval()


def success_interval(runs: Sequence[Sample], resamples: int = RESAMPLES) -> Interval:
    """IQM over units of the success rate with its interval, which stays within [0, 1].

    Where all episodes agree (all failed or all succeeded) the bootstrap has no width; Wilson's
    interval of the distinct episodes takes its place.
    """
    result = crossed_bootstrap(runs, iqm, resamples)
    if len(set(values := [run.value for run in runs])) == 1 and values[0] in (0.0, 1.0):
        episodes = len({seed for run in runs for block in run.blocks for seed in block.seeds})
        return Interval(result.value, *wilson(values[0] * episodes, episodes))
    return Interval(result.value, max(0.0, result.low), min(1.0, result.high))


@dataclass(frozen=True)
class Spread:
    """Standard deviations of a run's result: what base policy, run and episodes contribute.

    Attributes:
        policies: between base policies; None where no cell has several.
        runs: between runs on one policy; None where no policy has several.
        together: of policies and runs, where only their sum can be estimated.
        episodes: because a run is scored on a sample of episodes.
    """

    policies: float | None
    runs: float | None
    together: float | None
    episodes: float


def spread(cells: Sequence[Sequence[Sample]], resamples: int = 1000) -> Spread:
    """Variance components by the method of moments, pooled over cells.

    Sums of squares between runs of a policy, and between policies' means, less what the episodes
    contribute to them: the covariance of the runs under weights of the episodes (`Sample.draw`).
    Differences below 0 count as 0.
    """
    sums = np.sum([_sums_of_squares(runs, resamples) for runs in cells], axis=0)
    within, of_runs, between, of_policies, shares, policies, noise, runs = sums.tolist()
    per_run = max(0.0, within / of_runs) if of_runs else None
    # Of a policy with n runs the mean varies by its own variance and by 1/n of the runs'.
    means = max(0.0, between / of_policies) if of_policies else None
    per_policy = None
    if per_run is not None and means is not None:
        per_policy = max(0.0, means - shares / policies * per_run)

    def deviation(variance: float | None) -> float | None:
        return None if variance is None else math.sqrt(variance)

    return Spread(
        deviation(per_policy),
        deviation(per_run),
        deviation(means) if per_policy is None else None,
        math.sqrt(noise / runs),
    )


def _sums_of_squares(runs: Sequence[Sample], resamples: int) -> tuple[float, ...]:
    """For `spread`: sums of squares between runs of a policy and between policies, each without
    what episodes contribute and with its degrees of freedom; the sum over policies of 1 / its runs,
    and their number; the sum over runs of the variance due to episodes, and their number."""
    values = np.array([run.value for run in runs])
    noise = np.atleast_2d(np.cov([run.draw(resamples) for run in runs]))
    names = sorted({run.policy for run in runs})
    member = np.array([[run.policy == name for run in runs] for name in names], dtype=np.float64)
    average = member / member.sum(axis=1, keepdims=True)
    means, of_means = average @ values, average @ noise @ average.T
    within = ((values - means @ member) ** 2).sum() - noise.trace()
    return (
        within + (member @ noise @ average.T).trace(),
        len(runs) - len(names),
        ((means - means.mean()) ** 2).sum() - of_means.trace() + of_means.sum() / len(names),
        len(names) - 1,
        (1 / member.sum(axis=1)).sum(),
        len(names),
        noise.trace(),
        len(runs),
    )


Values = Sequence[tuple[str, float]]
"""(base policy, value) of each run of an agent in a cell."""


def probability_of_improvement(
    cells: Sequence[tuple[Values, Values]], resamples: int = RESAMPLES
) -> Interval:
    """P(X > Y) + P(X = Y) / 2 for runs of two agents on one base policy, mean over cells.

    `cells` holds (X's runs, Y's runs); runs on policies that only one of the two steers are left
    out. For each policy it is the Mann-Whitney statistic over all pairs of runs (Agarwal et al.
    2021), averaged over policies. The interval draws policies, or the runs of both agents where a
    cell has one policy. Where the policies of each cell agree the draws do not vary; Wilson's
    interval of the number of policies (or runs of the agent with fewer) takes its place. Raises
    ValueError without cells, or for a cell without a common policy.
    """
    if not cells:
        raise ValueError("there is no cell")
    drawn, names = [], []
    for index, (first, second) in enumerate(cells):
        units = sorted({policy for policy, _ in first} & {policy for policy, _ in second})
        if not units:
            raise ValueError("every cell needs runs of both agents on one base policy")
        wins = [_wins(first, second, policy) for policy in units]
        if len(units) > 1:
            drawn.append(_drawn(units, np.array([won.mean() for won in wins]), resamples))
        else:
            rows, columns = (
                [f"{index} {axis} {i}" for i in range(size)]
                for axis, size in enumerate(wins[0].shape)
            )
            value, of_first = _drawn(rows, wins[0].mean(axis=1), resamples)
            of_second = _drawn(columns, wins[0].mean(axis=0), resamples)[1]
            drawn.append((value, of_first + of_second))
            units = min(rows, columns, key=len)
        names.append(units)
    won, draws = _over_cells(drawn, names)
    if np.ptp(draws) < 1e-9:  # but for rounding they are equal
        number = len({name for units in names for name in units})
        return Interval(float(won), *wilson(float(won) * number, number))
    interval = percentile(float(won), draws)
    return Interval(interval.value, max(0.0, interval.low), min(1.0, interval.high))


def _wins(first: Values, second: Values, policy: str) -> Array:
    """Who wins each pair of runs on a base policy, 1 for the first, a half for both: [X, Y]."""
    x, y = (np.array([value for on, value in runs if on == policy]) for runs in (first, second))
    return (np.sign(np.subtract.outer(x, y)) + 1) / 2


def performance_profile(
    cells: Sequence[Values], thresholds: Sequence[float] | Array, resamples: int = RESAMPLES
) -> tuple[Array, Array, Array]:
    """Share of runs with a value >= each threshold, mean over cells: (share, low, high).

    The share of a cell is the mean over its base policies. The pointwise 95 % band draws these, or
    the runs where a cell has one policy. Raises ValueError without cells or for a cell without
    runs.
    """
    if not cells or not all(cells):
        raise ValueError("every cell needs runs")
    levels = np.asarray(thresholds, dtype=np.float64)
    drawn, names = [], []
    for index, runs in enumerate(cells):
        policies = np.array([policy for policy, _ in runs])
        reached = (np.array([value for _, value in runs])[:, None] >= levels).astype(np.float64)
        units = sorted(set(policies.tolist()))
        if len(units) == 1:
            units = [f"{index} {i}" for i in range(len(runs))]
        else:
            reached = np.stack([reached[policies == unit].mean(axis=0) for unit in units])
        drawn.append(_drawn(units, reached, resamples))
        names.append(units)
    share, draws = _over_cells(drawn, names)
    tail = (1 - CONFIDENCE) / 2
    low, high = np.clip(np.quantile(draws, (tail, 1 - tail), axis=0), 0, 1)
    return share, low, high


def _drawn(units: Sequence[str], values: Array, resamples: int) -> tuple[Array, Array]:
    """Mean over units of their values [units, ...], and what drawing them changes
    [resamples, ...] (`cell_estimates`)."""
    average, number = values.mean(axis=0), len(units)
    if number == 1:
        return average, np.zeros((resamples, *average.shape))
    weights = np.stack([unit_weights(unit, resamples) for unit in units], axis=1)
    weights = weights / weights.sum(axis=1, keepdims=True)
    change = np.einsum("ru,u...->r...", weights, values - average)
    return average, np.sqrt((number + 1) / (number - 1)) * change


def _over_cells(
    drawn: Sequence[tuple[Array, Array]], names: Sequence[Sequence[str]]
) -> tuple[Array, Array]:
    """The mean over cells of what was `_drawn` of units with these names, and its draws."""
    value = np.mean([average for average, _ in drawn], axis=0)
    changes = np.mean([change for _, change in drawn], axis=0)
    return value, value + tails(CONFIDENCE, degrees_of_freedom(names)) * changes


def paired_differences(first: Mapping[Key, float], second: Mapping[Key, float]) -> dict[Key, float]:
    """`first - second` for the keys (episodes) that both have."""
    return {key: value - second[key] for key, value in first.items() if key in second}


def area_weights(steps: Sequence[int], budget: int, begin: int = 0) -> tuple[float, ...]:
    """What each evaluation weighs in `area_under_curve`, which is linear in the values."""
    return tuple(area_under_curve(steps, list(unit), budget, begin) for unit in np.eye(len(steps)))


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
