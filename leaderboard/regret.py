"""What an agent loses against the best one of each cell, measured without favour.

The largest of several noisy means is larger than the mean of the agent that is truly best, so that
every agent seems to lose something. Here the best agent of a cell is chosen on one half of the base
policies and measured on the other half, then the halves are swapped. This regret may be negative.

The largest regret over cells is still that of an unlucky cell. It is compared with what an agent
that truly loses nothing would show there, from simulated repetitions of the same cells.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]
"""A measure by agent and base policy, ``[agents, policies]``."""

SPLITS = 100
"""Halves of the base policies over which a regret is averaged."""


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
