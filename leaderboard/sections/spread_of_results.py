"""How results vary: what base policies, runs and the sample of episodes contribute."""

from __future__ import annotations

from collections.abc import Mapping

from symsteer.leaderboard.rows import Summary
from symsteer.leaderboard.sections import Section, View
from symsteer.leaderboard.statistics import Spread, spread
from symsteer.leaderboard.text import NOTHING, SPACE, code, number, table_text


def spreads(summary: Summary) -> dict[str, Spread]:
    """Variance components of success in the final window, of agents with several runs in a cell."""
    spreads_of = {}
    for agent in summary.agents:
        rows = [row for table in summary.tables if (row := table.row_of(agent))]
        cells = [[run.success_sample for run in row.finished] for row in rows]
        if cells := [runs for runs in cells if len(runs) > 1]:
            spreads_of[agent] = spread(cells)
    return spreads_of


def render(spreads_of: Mapping[str, Spread], view: View) -> list[str]:
    """Standard deviations by agent; empty without several runs in a cell."""
    if not spreads_of:
        return []
    parts = [
        "Standard deviations of a run's success in the final window, pooled over cells, due to "
        "base policy, run, and the sample of episodes."
    ]
    alone = sum(len({run.policy for run in table.runs}) == 1 for table in view.summary.tables)
    if alone:
        which = "Each cell steers" if alone == len(view.summary.tables) else f"{alone} cells steer"
        parts[0] += (
            f" {which} one base policy: intervals are about this policy alone, and how much others "
            "differ is unknown."
        )
    if any(spread.together is not None for spread in spreads_of.values()):
        parts[0] += " Where each policy has one run, only the sum of both is known."
    rows = [
        {
            "Agent": code(agent),
            "Base policies": number(spread.policies, 3),
            "Runs on one": number(spread.runs, 3),
            "Both together": number(spread.together, 3),
            "Episodes": number(spread.episodes, 3),
            "Base policies' share of the variance": _share(spread),
        }
        for agent, spread in spreads_of.items()
    ]
    return [*parts, table_text(rows, sparse=True)]


def _share(spread: Spread) -> str:
    if spread.policies is None or spread.runs is None:
        return NOTHING
    total = spread.policies**2 + spread.runs**2 + spread.episodes**2
    return f"{100 * spread.policies**2 / total:.0f}{SPACE}%" if total else NOTHING


SECTION = Section(
    "How much is the base policy's", lambda findings: spreads(findings.summary), render
)
