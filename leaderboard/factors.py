"""Main effects of options, where an agent was run in a balanced grid of them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from symsteer.leaderboard.statistics import Array, Interval, Sample, cell_estimates, combined
from symsteer.leaderboard.summary import Key, Run, Summary, agent_options, is_balanced

Effect = Literal["success", "magnitude", "diverged"]
MEASURES: tuple[Effect, ...] = get_args(Effect)


@dataclass(frozen=True)
class MainEffect:
    """What changing one option does on average over the settings of the others.

    Attributes:
        levels: its two values; the effect is the second one's measure minus the first one's.
        measure: final-window success, largest |Q| over the largest feasible one, or the share of
            runs that diverged.
        means: of the measure with each of the two values, over cells and base policies.
        effect: their difference, with its 95 % interval.
        runs, policies: of which it is made.
    """

    agent: str
    option: str
    levels: tuple[str, str]
    measure: Effect
    means: tuple[float, float]
    effect: Interval
    runs: int
    policies: int


def main_effects(summary: Summary) -> list[MainEffect]:
    """By agent, option and measure; only of base policies for which the grid is balanced.

    Balanced: every pair of values of two options that vary occurs in equally many runs on a base
    policy in a cell, as in full grids and in fractions of them with a resolution of III or more.
    """
    found = []
    for agent in summary.agents:
        # The settings of a grid are tables of their own; here they belong together.
        worlds: dict[Key, list[Run]] = defaultdict(list)
        for table in summary.tables:
            runs = [run for row in table.trusted if row.agent == agent for run in row.runs]
            worlds[replace(table.key, settings="")] += runs
        cells = [runs for runs in worlds.values() if runs]
        options = _varied([run for runs in cells for run in runs])
        if len(options) < 2:
            continue
        for option, levels in options.items():
            for measure in MEASURES:
                effect = _effect(cells, options, option, measure)
                if effect:
                    found.append(MainEffect(agent, option, levels, measure, *effect))
    return found


def _varied(runs: Sequence[Run]) -> dict[str, tuple[str, str]]:
    """Options of the agent with two values, in order."""
    values: dict[str, set[str]] = {}
    for run in runs:
        for name, text in agent_options(run.record.config).items():
            values.setdefault(name, set()).add(text)
    return {name: _ordered(texts) for name, texts in values.items() if len(texts) == 2}


def _ordered(texts: set[str]) -> tuple[str, str]:
    def key(text: str) -> tuple[float, str]:
        try:
            return float(text), text
        except ValueError:
            return 0.0, text

    first, second = sorted(texts, key=key)
    return first, second


def _effect(
    cells: Sequence[Sequence[Run]],
    options: dict[str, tuple[str, str]],
    option: str,
    measure: Effect,
) -> tuple[tuple[float, float], Interval, int, int] | None:
    """Means, effect, and numbers of runs and policies; None if no base policy has a whole grid."""
    samples: list[list[Sample]] = []
    means: list[Array] = []
    number, policies = 0, set()
    for runs in cells:
        own, levels = [], []
        for policy in dict.fromkeys(run.policy for run in runs):
            measured = [
                (agent_options(run.record.config), value)
                for run in runs
                if run.policy == policy and (value := _of(run, measure)) is not None
            ]
            if not is_balanced([settings for settings, _ in measured], options):
                continue
            low, high = (
                float(np.mean([v for settings, v in measured if settings.get(option) == level]))
                for level in options[option]
            )
            levels.append((low, high))
            own.append(Sample.constant(high - low, policy))
            number += len(measured)
            policies.add(policy)
        if own:
            samples.append(own)
            means.append(np.mean(levels, axis=0))
    if not samples:
        return None
    low, high = map(float, np.mean(means, axis=0))
    return (low, high), combined(cell_estimates(samples)).interval(), number, len(policies)


def _of(run: Run, measure: Effect) -> float | None:
    """The measure of a run; None if it was not measured."""
    if measure == "success":
        return run.success if run.finished else None
    if measure == "diverged":
        return None if run.diverged is None else float(run.diverged)
    return run.record.divergence.magnitude if run.record.divergence else None
