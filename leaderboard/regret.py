"""What an agent loses against the best one of each cell, measured without favour.

The largest of several noisy means is larger than the mean of the agent that is truly best, so that
every agent seems to lose something. Here the best agent of a cell is chosen on one half of the base
policies and measured on the other half, then the halves are swapped. This regret may be negative.

The largest regret over cells is still that of an unlucky cell. It is compared with what an agent
that truly loses nothing would show there, from simulated repetitions of the same cells.

Intervals are those of the jackknife over base policies (Efron and Stein, 1981: its variance is too
large rather than too small). They hold for a regret as it is defined here: against the agent that
an experiment with half of the base policies would choose.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from symsteer.leaderboard.statistics import Interval

Values = NDArray[np.float64]
"""A measure by agent and base policy, ``[agents, policies]``."""

SPLITS = 100
"""Halves of the base policies over which a regret is averaged."""


@dataclass(frozen=True)
class Cell:
    """A measure in one cell.

    Attributes:
        values: ``[agents, policies]``.
        policies: names; a base policy that several cells share has the same name there.
        place: cells of other places share no base policy.
    """

    values: Values
    policies: Sequence[str]
    place: Hashable = ""

    def without(self, policy: str) -> Cell:
        """The cell without a base policy; itself if it does not have it."""
        kept = [index for index, name in enumerate(self.policies) if name != policy]
        if len(kept) == len(self.policies):
            return self
        return Cell(self.values[:, kept], [self.policies[i] for i in kept], self.place)


def over_cells(
    cells: Sequence[Cell], statistic: Callable[[Values], Values], splits: int = SPLITS
) -> list[Interval]:
    """A statistic of each agent's regrets with its 95 % interval.

    Args:
        cells: with the same agents and at least three base policies.
        statistic: ``[agents, cells] -> [agents]``, such as the mean.
        splits: see :func:`regrets`.
    """
    found = np.array([regrets(cell.values, splits) for cell in cells]).T
    policies: dict[Hashable, dict[str, None]] = defaultdict(dict)
    for cell in cells:
        policies[cell.place] |= dict.fromkeys(cell.policies)
    variance, freedom = np.zeros(len(found)), 0
    for names in policies.values():
        left_out = []
        for name in names:
            other = found.copy()
            for index, cell in enumerate(cells):
                if name in cell.policies:
                    other[:, index] = regrets(cell.without(name).values, splits)
            left_out.append(statistic(other))
        # The variance with its divisor n, times n - 1.
        variance += np.var(left_out, axis=0) * (len(names) - 1)
        freedom += len(names) - 1
    half = stats.t.ppf(0.975, freedom) * np.sqrt(variance)
    return [
        Interval(float(value), float(value - width), float(value + width))
        for value, width in zip(statistic(found), half, strict=True)
    ]


def regrets(values: Values, splits: int = SPLITS, seed: int = 0) -> Values:
    """By how much each agent is below the best one of a cell, ``[agents]``.

    Args:
        values: of at least two base policies.
        splits: random halves.
        seed: of the halves.
    """
    generator = np.random.default_rng(seed)
    policies = values.shape[1]
    ordered = values[:, [generator.permutation(policies) for _ in range(splits)]]
    first, second = ordered[..., : policies // 2].mean(-1), ordered[..., policies // 2 :].mean(-1)
    total = np.zeros(len(values))
    for chosen, measured in ((first, second), (second, first)):
        best = measured[chosen.argmax(0), np.arange(splits)]
        total += (best - measured).sum(1)
    return total / (2 * splits)


def of_an_agent_without_regret(
    cells: Sequence[Values], draws: int = 200, splits: int = 10, seed: int = 0
) -> Values:
    """Regrets that an agent would show whose true mean is the largest in each cell.

    The cells are repeated with residuals that are drawn anew: those of a base policy stay together,
    and the further agent has a residual of its own from all those of the cell.

    Args:
        cells: a table for each cell.
        draws: repetitions.
        splits, seed: see :func:`regrets`.

    Returns:
        ``[draws, cells]``.
    """
    generator = np.random.default_rng(seed)
    result = np.zeros((draws, len(cells)))
    for index, values in enumerate(cells):
        agents, policies = values.shape
        means = values.mean(1, keepdims=True)
        # A mean of few policies is too close to their values.
        residuals = (values - means) * np.sqrt(policies / (policies - 1))
        shared = residuals.mean(0)
        apart = (residuals - shared) * np.sqrt(agents / max(agents - 1, 1))
        for draw in range(draws):
            drawn = generator.integers(policies, size=policies)
            own = apart[generator.integers(agents, size=policies), drawn]
            further = means.max() + shared[drawn] + own
            repeated = np.vstack([means + residuals[:, drawn], further])
            result[draw, index] = regrets(repeated, splits, seed + draw)[-1]
    return result
