"""The estimators against known answers."""

import numpy as np
import pytest

from symsteer.bench.audit.estimates import (
    bootstrap,
    energy_distance,
    gaussian_distance_squared,
    mean,
    ratio,
    root_excess,
    root_share,
)


def test_intervals_cover_the_truth():
    rng = np.random.default_rng(0)
    covered = 0
    for trial in range(100):
        own = rng.uniform(1, 3, size=64)
        estimate = bootstrap(ratio, own * rng.uniform(0, 0.2, size=64), own, seed=trial)
        covered += estimate.low <= 0.1 <= estimate.high
    assert 88 <= covered <= 100


def test_resampling_is_over_states_and_seeded():
    values = np.random.default_rng(1).uniform(size=20)
    first, second = (bootstrap(mean, values, seed=3) for _ in range(2))
    assert first == second
    assert first.low < first.value == values.mean() < first.high
    constant = bootstrap(mean, np.full(5, 2.0), seed=0)
    assert (constant.low, constant.value, constant.high) == (2.0, 2.0, 2.0)


def test_a_share_of_a_length():
    """The root mean square of 3 and 1, of a mean of 2; what is due to chance is taken off."""
    whole, squares = np.array([1.0, 3.0]), np.array([9.0, 1.0])
    assert root_share(squares, np.zeros(2), whole) == pytest.approx(5**0.5 / 2)
    assert root_share(squares, np.ones(2), whole) == pytest.approx(1.0)
    assert root_excess(squares, np.ones(2)) == pytest.approx(2.0)
    assert root_excess(np.ones(2), squares) == 0.0
    assert np.isnan(root_share(np.ones(2), np.zeros(2), np.zeros(2)))


def test_states_at_rest_do_not_blow_up_a_ratio():
    defect, own = np.zeros(40), np.full(40, 1e-12)
    defect[:10], own[:10] = 0.5, 5.0
    assert bootstrap(ratio, defect, own, seed=0).value == pytest.approx(0.1)


def test_equal_distributions_have_no_energy_distance():
    values, p_values = [], []
    for seed in range(60):
        rng = np.random.default_rng(seed)
        measured, p = energy_distance(rng.normal(size=(40, 3)), rng.normal(size=(40, 3)), seed)
        values.append(measured.value)
        p_values.append(p)
    # Unbiased: zero on average for any size. The p-value is uniform.
    assert abs(np.mean(values)) < 3 * np.std(values) / np.sqrt(60)
    assert np.mean(np.array(p_values) < 0.1) < 0.25


def test_energy_distance_sees_and_is_bounded():
    rng = np.random.default_rng(0)
    x = rng.normal(size=(60, 2))
    near, p_near = energy_distance(x, rng.normal(size=(60, 2)) + np.array([2.0, 0.0]), 0)
    far, p_far = energy_distance(x, rng.normal(size=(60, 2)) + np.array([1e4, 0.0]), 0)
    assert 0 < near.low < near.value < near.high < far.value <= 1
    assert far.value > 0.99
    assert max(p_near, p_far) == 0.001


def test_energy_distance_of_two_points():
    """X is 0 or 1 with equal odds, Y is always 1: E|X-Y| = 1/2, E|X-X'| = 1/2, hence H = 1/2."""
    x = np.repeat([0.0, 1.0], 200)[:, None]
    estimate, _ = energy_distance(x, np.ones((400, 1)), 0)
    assert estimate.value == pytest.approx(0.5, abs=0.01)


def test_distance_of_gaussians():
    rng = np.random.default_rng(0)
    a = rng.normal(size=(3, 100_000, 2)) * [1.0, 4.0] + [0.0, 2.0]
    b = rng.normal(size=(3, 100_000, 2)) * [4.0, 1.0]
    # Axis-aligned Gaussians: |m|^2 + sum of (s_a - s_b)^2 = 4 + 9 + 9.
    np.testing.assert_allclose(gaussian_distance_squared(a, b), 22.0, rtol=0.02)
    single = gaussian_distance_squared(a[:, :1], b[:, :1])
    np.testing.assert_allclose(single, ((a[:, 0] - b[:, 0]) ** 2).sum(axis=-1))
