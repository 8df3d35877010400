"""Intervals of shares of successes, and the area under a learning curve."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from scipy import special
from scipy.integrate import trapezoid

CONFIDENCE = 0.95


def normal_quantile(confidence: float) -> float:
    """How many standard deviations an interval of this confidence reaches to each side."""
    return float(special.ndtri((1 + confidence) / 2))


def wilson(successes: float, trials: float, confidence: float = CONFIDENCE) -> tuple[float, float]:
    """Wilson's interval of a success probability; the numbers need not be whole."""
    z, share = normal_quantile(confidence), successes / trials
    centre = (share + z**2 / (2 * trials)) / (1 + z**2 / trials)
    half = z * math.sqrt(share * (1 - share) / trials + z**2 / (4 * trials**2))
    half /= 1 + z**2 / trials
    # At the ends the formula gives 0 and 1, up to rounding.
    return 0.0 if share == 0 else centre - half, 1.0 if share == 1 else centre + half


def newcombe(
    first: tuple[float, float], second: tuple[float, float], confidence: float = CONFIDENCE
) -> tuple[float, float]:
    """Interval of the first share minus the second, each (successes, trials).

    It combines the two Wilson intervals (Newcombe 1998, method 10); unlike a bootstrap it has a
    width when nobody or everybody succeeds.
    """
    p, q = first[0] / first[1], second[0] / second[1]
    p_low, p_high = wilson(*first, confidence)
    q_low, q_high = wilson(*second, confidence)
    return p - q - math.hypot(p - p_low, q_high - q), p - q + math.hypot(p_high - p, q - q_low)


def area_under_curve(
    steps: Sequence[int], values: Sequence[float], budget: int, begin: int = 0
) -> float:
    """Mean height of a learning curve from step `begin` to the budget, by the trapezoidal rule.

    The first value is held back to step 0 and the last one on to the budget; what lies beyond the
    budget is left out. One evaluation gives its own value.
    """
    knots = np.array([0, *steps, max(budget, steps[-1])], dtype=np.float64)
    heights = np.array([values[0], *values, values[-1]], dtype=np.float64)
    within = knots[(knots > begin) & (knots < budget)]
    inside = np.unique([float(begin), *within, float(budget)])
    return float(trapezoid(np.interp(inside, knots, heights), inside) / (budget - begin))
