"""Agents that were run in a grid of their options: its settings apart, and main effects."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from symsteer.leaderboard.statistics import Interval, Sample, cell_estimates, combined
from symsteer.leaderboard.summary import Row, Run, Summary, Table, setting_texts

Effect = Literal["success", "magnitude", "diverged"]
MEASURES: tuple[Effect, ...] = get_args(Effect)

PREFIX = "agent_options."


@dataclass(frozen=True)
class MainEffect:
    """What changing one option does on average over the settings of the others.

    Attributes:
        levels: its two values; the effect is the second one's measure minus the first one's.
        measure: final-window success, largest |Q| over the largest feasible one, or the share of
            runs that diverged.
        effect: mean over cells and base policies, 95 % interval.
        runs, policies: of which it is made.
    """

    agent: str
    option: str
    levels: tuple[str, str]
    measure: Effect
    effect: Interval
    runs: int
    policies: int


def by_setting(table: Table) -> list[Table]:
    """A part of the table for each setting of the options that vary within any of its agents."""
    options = {id(row): _options(row.runs[0]) for row in table.rows if row.runs}
    varied = set()
    for agent in {row.agent for row in table.rows}:
        own = [options[id(row)] for row in table.rows if row.agent == agent and row.runs]
        names = {name for texts in own for name in texts}
        varied |= {name for name in names if len({texts.get(name) for texts in own}) > 1}
    parts: dict[tuple[str | None, ...], list[Row]] = defaultdict(list)
    for row in table.rows:
        if row.runs:
            parts[tuple(options[id(row)].get(name) for name in sorted(varied))].append(row)
    return [replace(table, rows=rows) for rows in parts.values()]


def main_effects(summary: Summary) -> list[MainEffect]:
    """By agent, option and measure; only of base policies for which the grid is balanced.

    Balanced: every pair of values of two options that vary occurs in equally many runs on a base
    policy in a cell, as in full grids and in fractions of them with a resolution of III or more.
    """
    found = []
    for agent in summary.agents:
        cells = [
            runs
            for table in summary.tables
            if (runs := [r for row in table.rows if row.agent == agent for r in row.runs])
        ]
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
        for name, text in _options(run).items():
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


def _options(run: Run) -> dict[str, str]:
    texts = setting_texts(run.record.config)
    return {k.removeprefix(PREFIX): text for k, text in texts.items() if k.startswith(PREFIX)}


def _effect(
    cells: Sequence[Sequence[Run]],
    options: dict[str, tuple[str, str]],
    option: str,
    measure: Effect,
) -> tuple[Interval, int, int] | None:
    samples: list[list[Sample]] = []
    number, policies = 0, set()
    for runs in cells:
        own = []
        for policy in dict.fromkeys(run.policy for run in runs):
            measured = [
                (_options(run), value)
                for run in runs
                if run.policy == policy and (value := _of(run, measure)) is not None
            ]
            if not _is_balanced([settings for settings, _ in measured], options):
                continue
            low, high = (
                np.mean([v for settings, v in measured if settings.get(option) == level])
                for level in options[option]
            )
            own.append(Sample.constant(float(high - low), policy))
            number += len(measured)
            policies.add(policy)
        if own:
            samples.append(own)
    if not samples:
        return None
    return combined(cell_estimates(samples)).interval(), number, len(policies)


def _of(run: Run, measure: Effect) -> float | None:
    """The measure of a run; None if it was not measured."""
    if measure == "success":
        return run.success if run.finished else None
    if measure == "diverged":
        return None if run.diverged is None else float(run.diverged)
    return run.record.divergence.magnitude if run.record.divergence else None


def _is_balanced(settings: Sequence[dict[str, str]], options: dict[str, tuple[str, str]]) -> bool:
    names = list(options)
    for index, first in enumerate(names):
        for second in names[index + 1 :]:
            pairs = Counter((s.get(first), s.get(second)) for s in settings)
            if len(pairs) != 4 or len(set(pairs.values())) != 1:
                return False
    return bool(settings)
