"""Main effects of options, where an agent was run in a balanced grid of them."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from symsteer.leaderboard.keys import Key, agent_options, is_balanced
from symsteer.leaderboard.rows import MIN_SEEDS, Summary
from symsteer.leaderboard.runs import Run
from symsteer.leaderboard.sections import Section, View
from symsteer.leaderboard.statistics import Array, Interval, Sample, stratified_bootstrap
from symsteer.leaderboard.text import NOTHING, SPACE, code, mark_of, number, stacked, table_text

Measure = Literal["success", "magnitude", "diverged"]
COLUMNS: dict[Measure, str] = {
    "success": "Success",
    "magnitude": "Largest \\|Q\\|",
    "diverged": "Diverged",
}

EXPLAINED = f"""\
Some agents were run in a balanced grid of options. Shown are the means with both values of an
option, over all settings of the others, on the same base policies, and the main effect, the second
mean minus the first: of final success, of the largest |Q| as a multiple of the largest feasible
one, and of the share of diverged runs. Marks need {MIN_SEEDS} base policies."""


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
    measure: Measure
    means: tuple[float, float]
    effect: Interval
    runs: int
    policies: int


def main_effects(summary: Summary) -> list[MainEffect]:
    """By agent, option and measure; only of base policies for which the grid is balanced.

    Balanced: every pair of values of two options that vary occurs in equally many runs on a base
    policy in a cell, as in full grids and in fractions of them with a resolution of III or more.
    """
    effects = []
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
        effects += [_effect(agent, cells, options, o, m) for o in options for m in COLUMNS]
    return [effect for effect in effects if effect]


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
    agent: str,
    cells: Sequence[Sequence[Run]],
    options: dict[str, tuple[str, str]],
    option: str,
    measure: Measure,
) -> MainEffect | None:
    """The effect of one option; None if no base policy has a whole grid."""
    samples: list[list[Sample]] = []
    means: list[Array] = []
    count, policies = 0, set()
    for runs in cells:
        effects, levels = [], []
        for policy in dict.fromkeys(run.policy for run in runs):
            measured = [
                (agent_options(run.record.config), value)
                for run in runs
                if run.policy == policy and (value := run.measured(measure)) is not None
            ]
            if not is_balanced([settings for settings, _ in measured], options):
                continue
            low, high = (
                float(np.mean([v for settings, v in measured if settings.get(option) == level]))
                for level in options[option]
            )
            levels.append((low, high))
            effects.append(Sample.constant(high - low, policy))
            count += len(measured)
            policies.add(policy)
        if effects:
            samples.append(effects)
            means.append(np.mean(levels, axis=0))
    if not samples:
        return None
    low, high = map(float, np.mean(means, axis=0))
    return MainEffect(
        agent=agent,
        option=option,
        levels=options[option],
        measure=measure,
        means=(low, high),
        effect=stratified_bootstrap(samples),
        runs=count,
        policies=len(policies),
    )


def render(effects: Sequence[MainEffect], view: View) -> list[str]:
    """Both means and their difference by agent, option and measure; empty without a grid."""
    if not effects:
        return []
    rows: dict[tuple[str, str], dict[str, str]] = {}
    for one in effects:
        change = f"{code(one.option)} {code(one.levels[0])} to {code(one.levels[1])}"
        row = rows.setdefault(
            (one.agent, change),
            {
                "Agent": code(one.agent),
                "Change": change,
                **dict.fromkeys(COLUMNS.values(), NOTHING),
            },
        )
        mark = mark_of(one.effect) if one.policies >= MIN_SEEDS else ""
        means = f"{number(one.means[0])} to {number(one.means[1])}".replace(" ", SPACE)
        row[COLUMNS[one.measure]] = f"{means}<br>{stacked(one.effect, sign=True, marks=mark)}"
        row["Runs, policies"] = f"{one.runs}, {one.policies}"
    return [EXPLAINED, table_text(list(rows.values()), left=2)]


SECTION = Section("Effects of options", lambda findings: main_effects(findings.summary), render)
