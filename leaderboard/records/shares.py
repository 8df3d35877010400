"""Intervals of shares of successes."""

from __future__ import annotations

import math

from scipy import special

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
