"""Estimators of the audit: bootstrap intervals, energy distance, distance of Gaussians.

All are pure functions of numbers and a seed. Resampling draws whole states (one per episode) or
whole resets, never single numbers of a state.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

Array = NDArray[np.float64]

CONFIDENCE = 0.95
RESAMPLES = 1000
PERMUTATIONS = 999


@dataclass(frozen=True)
class Measurement:
    """A number with its 95 % bootstrap interval."""

    value: float
    low: float
    high: float


def mean(values: Array, axis: int = -1) -> Array:
    """Mean over states."""
    return values.mean(axis=axis)


def ratio(part: Array, whole: Array, axis: int = -1) -> Array:
    """Ratio of means; nan if the denominator is zero."""
    below = whole.mean(axis=axis)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(below > 0, part.mean(axis=axis) / below, np.nan)


def root_excess(squares: Array, chance: Array, axis: int = -1) -> Array:
    """Root of mean ``squares`` minus mean ``chance`` (squares due to chance alone), at least 0."""
    return np.sqrt(np.maximum(squares.mean(axis=axis) - chance.mean(axis=axis), 0.0))


def root_share(squares: Array, chance: Array, whole: Array, axis: int = -1) -> Array:
    """`root_excess` as a share of the mean ``whole``; nan if that is zero."""
    below = whole.mean(axis=axis)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(below > 0, root_excess(squares, chance, axis) / below, np.nan)


def bootstrap(statistic: Callable[..., Any], *columns: Any, seed: int) -> Measurement:
    """Compute ``statistic`` of ``columns``, each ``[S]``, with a percentile interval over states.

    The columns are resampled together: entry i of each belongs to state i.

    Raises:
        ValueError: with fewer than two states.
    """
    data = tuple(np.asarray(column, dtype=np.float64) for column in columns)
    value = float(statistic(*data))
    if all(np.ptp(column) == 0 for column in data) and len(data[0]) > 1:
        return Measurement(value, value, value)
    return _with_interval(value, statistic, data, np.random.default_rng(seed), paired=True)


def _with_interval(
    value: float,
    statistic: Callable[..., Any],
    data: Sequence[Any],
    generator: np.random.Generator,
    **options: Any,
) -> Measurement:
    interval = stats.bootstrap(
        data,
        statistic,
        vectorized=True,
        n_resamples=RESAMPLES,
        confidence_level=CONFIDENCE,
        method="percentile",
        rng=generator,
        **options,
    ).confidence_interval
    return Measurement(value, float(interval.low), float(interval.high))


def energy_distance(x: Array, y: Array, seed: int) -> tuple[Measurement, float]:
    """Normalised energy distance of two samples.

    The coefficient of inhomogeneity (Szekely and Rizzo 2013)
    H = (2 E|X - Y| - E|X - X'| - E|Y - Y'|) / (2 E|X - Y|) lies in [0, 1] and is 0 only for equal
    distributions. Expectations are estimated by U-statistics: equal distributions give 0 on
    average, and slightly negative values occur.

    Args:
        x: sample ``[n, d]``.
        y: independent sample ``[m, d]``.
        seed: of bootstrap and permutations.

    Returns:
        H with its bootstrap interval, and the p-value of the permutation test of equality.
    """
    n, m = len(x), len(y)
    pooled = np.concatenate([x, y])
    squares = (pooled**2).sum(axis=1)
    distance = np.sqrt(np.maximum(squares[:, None] + squares[None, :] - 2 * pooled @ pooled.T, 0.0))
    np.fill_diagonal(distance, 0.0)
    within_x, within_y, between = distance[:n, :n], distance[n:, n:], distance[:n, n:]

    def inhomogeneity(rows: Any, columns: Any, axis: int = -1) -> Array:
        first, second = _counts(rows, n), _counts(columns, m)
        cross = ((first @ between) * second).sum(axis=-1) / (n * m)
        within = sum(
            # Pairs of a reset with itself do not count, also if it was drawn twice.
            ((w @ d) * w).sum(axis=-1) / (w.sum(axis=-1) ** 2 - (w**2).sum(axis=-1))
            for w, d in ((first, within_x), (second, within_y))
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(cross > 0, 1 - within / (2 * cross), 0.0)

    value = float(inhomogeneity(np.arange(n), np.arange(m)))
    generator = np.random.default_rng(seed)
    resets = np.arange(n), np.arange(m)
    measured = _with_interval(value, inhomogeneity, resets, generator, batch=100)
    # Sums over the permuted first sample give all three expectations of a permutation.
    labels = np.zeros((PERMUTATIONS, n + m))
    labels[:, :n] = 1
    labels = generator.permuted(labels, axis=1)
    total = distance.sum()
    to_first = labels @ distance
    first_first = (to_first * labels).sum(axis=1)
    first_all = to_first.sum(axis=1)
    cross = (first_all - first_first) / (n * m)
    second_second = total - 2 * first_all + first_first
    within = first_first / (n * (n - 1)) + second_second / (m * (m - 1))
    permuted = np.where(cross > 0, 1 - within / np.maximum(2 * cross, 1e-300), 0.0)
    p_value = (1 + int((permuted >= value - 1e-12).sum())) / (1 + PERMUTATIONS)
    return measured, p_value


def _counts(index: Any, size: int) -> Array:
    """Number of times each row was drawn: indices ``[..., n]`` to counts ``[..., size]``."""
    index = np.asarray(index)
    flat = index.reshape(-1, index.shape[-1]).astype(np.int64)
    shifted = flat + size * np.arange(len(flat))[:, None]
    counts = np.bincount(shifted.ravel(), minlength=size * len(flat)).astype(np.float64)
    return counts.reshape(*index.shape[:-1], size)


def gaussian_distance_squared(a: Array, b: Array) -> Array:
    """Squared 2-Wasserstein distance of Gaussians fitted to two sets of draws.

    |m_a - m_b|^2 + tr(C_a + C_b - 2 (C_a^(1/2) C_b C_a^(1/2))^(1/2)); the squared difference for
    a single draw each.

    Args:
        a: draws ``[..., K, d]``.
        b: draws ``[..., K, d]``.

    Returns:
        ``[...]``.
    """
    shift = ((a.mean(axis=-2) - b.mean(axis=-2)) ** 2).sum(axis=-1)
    if a.shape[-2] < 2:
        return shift
    first, second = _covariance(a), _covariance(b)
    root = _square_root(first)
    middle = _square_root(root @ second @ root)
    spread = np.trace(first + second - 2 * middle, axis1=-2, axis2=-1)
    return shift + np.maximum(spread, 0.0)


def _covariance(draws: Array) -> Array:
    centred = draws - draws.mean(axis=-2, keepdims=True)
    return np.swapaxes(centred, -1, -2) @ centred / (draws.shape[-2] - 1)


def _square_root(matrix: Array) -> Array:
    """Root of symmetric positive semidefinite matrices ``[..., d, d]``."""
    values, vectors = np.linalg.eigh((matrix + np.swapaxes(matrix, -1, -2)) / 2)
    return (vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]) @ np.swapaxes(vectors, -1, -2)
