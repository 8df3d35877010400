"""Performance profiles: the share of runs that close at least a share of the gap to success.

As in Agarwal et al. 2021 (arXiv 2108.13264): a number for each run, all runs shown, intervals from
a bootstrap that is stratified by table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from symsteer.leaderboard.figures import MANY, SHARE, look_of
from symsteer.leaderboard.known_agents import BASE
from symsteer.leaderboard.pairs import reference_success
from symsteer.leaderboard.plots import Axis, Figure, Plot, Rule, Trace, cut
from symsteer.leaderboard.records import Role
from symsteer.leaderboard.rows import AgentRow, Summary, Table
from symsteer.leaderboard.sections import Section, View
from symsteer.leaderboard.statistics import Array, performance_profile

TITLE = "All cells together"

GROUPS = ("unbroken", "broken")

THRESHOLDS = np.linspace(-0.5, 1.0, 151)
"""Where the profiles are drawn: shares of the gap between the frozen base and certain success."""

EXPLAINED = (
    "Performance profiles: the share of runs that close at least the given share of the gap "
    "between the frozen base (0, on the same episodes) and certain success (1), in the final "
    "window. Higher is better; left of 0 steering does harm. Bands are 95 %."
)


@dataclass(frozen=True)
class Profile:
    """Share of an agent's runs that close at least each share of the gap (`THRESHOLDS`)."""

    agent: str
    role: Role
    cells: int
    runs: int
    share: Array
    low: Array
    high: Array


def groups(summary: Summary) -> dict[str, list[Table]]:
    """Tables with learners: those of the unbroken, arm-less control, and the broken ones."""
    tables: dict[str, list[Table]] = {group: [] for group in GROUPS}
    for table in summary.tables:
        if table.learners:
            tables[GROUPS[bool(table.key.broken_by)]].append(table)
    return {group: members for group, members in tables.items() if members}


def profiles(summary: Summary) -> dict[str, list[Profile]]:
    """By group of tables: a profile for every agent but the base that has runs."""
    by_group: dict[str, list[Profile]] = {}
    for group, tables in groups(summary).items():
        by_group[group] = []
        for agent, role in summary.roles.items():
            rows = [(table.row_of(agent), table.row_of(BASE)) for table in tables]
            gaps = [gap_closed(row, base) for row, base in rows if row and base and agent != BASE]
            if cells := [gap for gap in gaps if gap]:
                share, low, high = performance_profile(cells, THRESHOLDS)
                sizes = {"cells": len(cells), "runs": sum(map(len, cells))}
                profile = Profile(agent, role, **sizes, share=share, low=low, high=high)
                by_group[group].append(profile)
    return by_group


def gap_closed(row: AgentRow, base: AgentRow) -> list[tuple[str, float]]:
    """Base policy and (success - base) / (1 - base) of each finished run, final window, same
    episodes.

    0 is the frozen base policy, 1 success in every episode, negative is worse than the base. Runs
    without common episodes, or whose base always succeeds, are left out.
    """
    values = []
    for run in row.finished:
        reference = reference_success(run, base.finished)
        episodes = [(s, reference[key[1]]) for key, s in run.window.items() if key[1] in reference]
        if not episodes:
            continue
        success, of_base = np.mean(episodes, axis=0)
        if of_base < 1:
            values.append((run.policy, float((success - of_base) / (1 - of_base))))
    return values


def render(by_group: dict[str, list[Profile]], view: View) -> list[str]:
    """The figure and what it means; empty without profiles. A site has charts of its own."""
    if not any(by_group.values()):
        return []
    return [*view.drawn(kind="profiles"), EXPLAINED]


def figure(by_group: dict[str, list[Profile]], summary: Summary) -> Figure:
    """Share of runs that close at least a share of the gap to certain success, with 95 % bands."""
    cells = cells_of(summary)
    title, legend, plots = "share of the gap from the base to certain success", {}, []
    for group, members in by_group.items():
        traces = []
        for profile in members:
            name, is_reference = cut(profile.agent), profile.role == "reference"
            legend[name] = replace(look_of(profile.agent, width=1.7), marker="")
            some = profile.cells < cells[group]
            remark = f"{cells_text(profile.cells)} only" if some else ""
            band = () if is_reference else (profile.low, profile.high, 0.13)
            trace = Trace(name, THRESHOLDS, profile.share, legend[name], *band)
            traces.append(replace(trace, remark=remark))
        if traces:
            x, y = Axis(title, _from_start(members)), Axis("share of runs at or above", SHARE)
            plot = Plot(
                x, y, traces, [], [Rule(0, is_vertical=True)], group_title(group, cells[group])
            )
            plots.append(replace(plot, is_crowded=sum(bool(t.band) for t in traces) >= MANY))
    return Figure(
        plots,
        legend,
        height=3.3,
        columns=len(plots),
        same_y=True,
        kind="profiles",
        text="Performance profiles",
    )


def _from_start(profiles: Sequence[Profile]) -> tuple[float, float]:
    """From a little left of 0, or of the largest share that all runs reach."""
    all_in = np.min([profile.share for profile in profiles], axis=0) == 1
    start = min(THRESHOLDS[all_in].max(initial=THRESHOLDS[0]), 0.0)
    return float(start - 0.03), float(THRESHOLDS[-1])


def cells_of(summary: Summary) -> dict[str, int]:
    """How many cells each group of tables has."""
    return {group: len(tables) for group, tables in groups(summary).items()}


def cells_text(number: int) -> str:
    return f"{number} cell{'s' if number > 1 else ''}"


def group_title(group: str, cells: int) -> str:
    return f"{group} symmetry, {cells_text(cells)}"


SECTION = Section(
    TITLE,
    lambda findings: profiles(findings.summary),
    render,
    figures=lambda by_group, summary: [figure(by_group, summary)] if any(by_group.values()) else [],
)
