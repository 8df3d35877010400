"""What an agent loses against the best one of each cell, measured without favour.

The largest of several noisy means is larger than the mean of the agent that is truly best, so that
every agent seems to lose something; and the largest of several noisy losses is that of an unlucky
cell. So base policies are cut in halves. One half chooses the best agent of each cell, and the
worst cell of each agent; the other half measures. Then they are swapped. Such a regret may be
negative.

Intervals are those of the jackknife over base policies (Efron and Stein, 1981: its variance is too
large rather than too small). They hold for a regret as it is defined here: of what an experiment
with half of the base policies would choose.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from symsteer.leaderboard.statistics import Interval

Values = NDArray[np.float64]

SPLITS = 1000
"""Halves of the base policies over which a regret is averaged."""


@dataclass(frozen=True)
class Cell:
    """A measure in one cell.

    Attributes:
        values: ``[agents, policies]``.
        policies: their names, at least two; a base policy has the same name in all cells, and no
            other one has it.
        place: cells of other places share no base policy.
    """

    values: Values
    policies: Sequence[str]
    place: Hashable = ""

    def without(self, policy: str) -> Cell:
        """The cell without a base policy, which it has."""
        kept = [index for index, name in enumerate(self.policies) if name != policy]
        return Cell(self.values[:, kept], [self.policies[i] for i in kept], self.place)


@dataclass(frozen=True)
class Regrets:
    """By how much agents are below the best one.

    Attributes:
        cells: ``[agents, cells]``.
        mean, worst: over cells, ``[agents]``.
    """

    cells: Values
    mean: Values
    worst: Values


def regrets(cells: Sequence[Cell], splits: int = SPLITS, seed: int = 0) -> Regrets:
    """Regrets of the agents that all cells have.

    Args:
        cells: with the same agents.
        splits: random halves.
        seed: of the halves.
    """
    return _regrets([_halves(cell, splits, seed) for cell in cells])


def _halves(cell: Cell, splits: int, seed: int) -> Values:
    return _below(cell.values, _orders(tuple(cell.policies), splits, seed))


@lru_cache(maxsize=256)
def _orders(policies: tuple[str, ...], splits: int, seed: int) -> NDArray[np.intp]:
    """Random orders of base policies, ``[splits, policies]``, cut into halves in the middle.

    The same base policies are in the same halves in all cells.
    """
    generators = [np.random.default_rng([seed, *name.encode()]) for name in policies]
    return np.stack([each.random(splits) for each in generators], axis=1).argsort(1)


def _below(values: Values, orders: NDArray[np.intp]) -> Values:
    """Below the best agent, chosen and measured on each half: ``[2, ..., splits * 2, agents]``.

    Args:
        values: ``[..., agents, policies]``.
        orders: ``[..., splits, policies]``.
    """
    ordered = np.take_along_axis(values[..., None, :, :], orders[..., None, :], -1)
    cut, found = orders.shape[-1] // 2, []
    halves = ordered[..., :cut].mean(-1), ordered[..., cut:].mean(-1)
    for chosen, measured in (halves, halves[::-1]):
        best = np.take_along_axis(measured, chosen.argmax(-1)[..., None], -1)
        found.append([chosen.max(-1, keepdims=True) - chosen, best - measured])
    return np.concatenate(found, axis=-2)


def _regrets(halves: Sequence[Values]) -> Regrets:
    """From `_below` of each cell; repetitions stay in front."""
    chosen, measured = np.stack(halves, axis=-1)
    worst = np.take_along_axis(measured, chosen.argmax(-1)[..., None], -1)[..., 0]
    return Regrets(measured.mean(-3), measured.mean((-3, -1)), worst.mean(-2))


def intervals(cells: Sequence[Cell], splits: int = SPLITS) -> tuple[list[Interval], list[Interval]]:
    """Mean and worst regret of each agent with their 95 % intervals.

    Args:
        cells: with the same agents and at least three base policies.
        splits: see :func:`regrets`.
    """
    halves = [_halves(cell, splits, 0) for cell in cells]
    policies: dict[Hashable, dict[str, None]] = defaultdict(dict)
    for cell in cells:
        policies[cell.place] |= dict.fromkeys(cell.policies)
    variances, freedoms = [], []
    for names in policies.values():
        left_out = []
        for name in names:
            lacks = [name in cell.policies for cell in cells]
            other = [
                _halves(cell.without(name), splits, 0) if lack else half
                for cell, half, lack in zip(cells, halves, lacks, strict=True)
            ]
            found = _regrets(other)
            left_out.append([found.mean, found.worst])
        # The variance with its divisor n, times n - 1.
        variances.append(np.var(left_out, axis=0) * (len(names) - 1))
        freedoms.append(len(names) - 1)
    found, of_places = _regrets(halves), np.array(variances)
    student = partial(_student, freedoms=np.array(freedoms))
    mean, worst = (
        [student(value, of_places[:, which, agent]) for agent, value in enumerate(values)]
        for which, values in enumerate((found.mean, found.worst))
    )
    return mean, worst


def _student(value: float, variances: Values, freedoms: Values) -> Interval:
    """Interval for a sum of independent variances (Satterthwaite, 1946)."""
    total = variances.sum()
    freedom = total**2 / (variances**2 / freedoms).sum() if total else 1
    half = stats.t.ppf(0.975, freedom) * np.sqrt(total)
    return Interval(float(value), float(value - half), float(value + half))


def of_an_agent_without_regret(
    cells: Sequence[Cell], draws: int = 3000, splits: int = 5, seed: int = 0
) -> tuple[Values, Values]:
    """Regrets that an agent would show whose true mean is the largest in each cell.

    The cells are repeated with residuals that are drawn anew: those of a base policy stay together,
    and the further agent has a residual of its own from all those of the cell.

    Args:
        cells: with the same agents.
        draws: repetitions.
        splits, seed: see :func:`regrets`.

    Returns:
        Its mean and its worst regret in each repetition, both ``[draws]``.
    """
    generator, halves = np.random.default_rng(seed), []
    for cell in cells:
        orders = _orders(tuple(cell.policies), draws * splits, seed)
        repeated = _with_the_best(cell, draws, generator)
        halves.append(_below(repeated, orders.reshape(draws, splits, -1)))
    found = _regrets(halves)
    return found.mean[:, -1], found.worst[:, -1]


def _with_the_best(cell: Cell, draws: int, generator: np.random.Generator) -> Values:
    """Repetitions with the further agent as the last one, ``[draws, agents + 1, policies]``."""
    agents, policies = cell.values.shape
    means = cell.values.mean(1, keepdims=True)
    # A mean of few policies is too close to their values.
    residuals = (cell.values - means) * np.sqrt(policies / (policies - 1))
    shared = residuals.mean(0)
    apart = (residuals - shared) * np.sqrt(agents / max(agents - 1, 1))
    drawn = generator.integers(policies, size=(draws, policies))
    own = apart[generator.integers(agents, size=drawn.shape), drawn]
    further = means.max() + shared[drawn] + own
    known = means + residuals[:, drawn].swapaxes(0, 1)
    return np.concatenate([known, further[:, None]], axis=1)
