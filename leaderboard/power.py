"""How many more base policies would decide a claim."""

from __future__ import annotations

from dataclasses import dataclass

from scipy.stats import norm

from symsteer.leaderboard.claims import Outcome
from symsteer.leaderboard.statistics import CONFIDENCE, Interval

POWER = 0.8


@dataclass(frozen=True)
class Needed:
    """How many times as many base policies a test needs.

    Attributes:
        to_find: to find the smallest effect of interest, if the effect is that large.
        to_exclude: to show that the effect is smaller, if it is what was measured; None if what was
            measured is not smaller.
    """

    to_find: float
    to_exclude: float | None


def needed(outcome: Outcome, tests: int) -> Needed | None:
    """What a tested claim needs for a power of `POWER`; None if it was not tested.

    The standard error is taken from the interval, and falls with the root of the number of base
    policies. Of a family of `tests`, Holm's first step is asked for, which is the hardest.
    """
    if outcome.reason or outcome.effect is None:
        return None
    found, level = outcome.effect.interval(), (1 - CONFIDENCE) / tests
    margin, error = outcome.claim.smallest, standard_error(found)
    room = margin - abs(found.value)
    return Needed(
        float(((norm.isf(level / 2) + norm.ppf(POWER)) * error / margin) ** 2),
        # Both of the one-sided tests must succeed.
        float(((norm.isf(level) + norm.ppf((1 + POWER) / 2)) * error / room) ** 2)
        if room > 0
        else None,
    )


def standard_error(found: Interval) -> float:
    """Of a normal distribution with this interval."""
    return (found.high - found.low) / 2 / float(norm.isf((1 - CONFIDENCE) / 2))
