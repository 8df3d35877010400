"""Everything that is computed over all tables together."""

from __future__ import annotations

from dataclasses import dataclass

from symsteer.leaderboard.advice import LeaveOut, leave_tasks_out
from symsteer.leaderboard.answer import Gain, gains
from symsteer.leaderboard.claims import Outcome, claims
from symsteer.leaderboard.comparisons import Comparisons, compare_agents
from symsteer.leaderboard.defects import Audit, DefectMap, defect_map, fingerprint
from symsteer.leaderboard.statistics import Spread, spread
from symsteer.leaderboard.study import Study
from symsteer.leaderboard.summary import Summary, success_sample


@dataclass(frozen=True)
class Findings:
    """What is computed over all tables together."""

    gains: list[Gain]
    """Advantage of symmetry by kind of break."""
    map: DefectMap
    """Advantage of symmetry against the audited defect."""
    left_out: list[LeaveOut]
    """How often the map is right about a task that it does not know, by embodiment."""
    comparisons: Comparisons
    study: Study
    claims: list[Outcome]
    """The study's claims."""
    spreads: dict[str, Spread]
    """How the results of runs vary, by agent."""
    audit: str
    """Which audit the defects are from (`fingerprint`)."""


def analyse(summary: Summary, audit: Audit, study: Study) -> Findings:
    """Compute all findings; the same summary, audit and study give the same numbers.

    Raises UserError for names in the study that nothing has (`claims`).
    """
    found = defect_map(summary, audit)
    return Findings(
        gains(summary, audit),
        found,
        [leave_tasks_out([summary], audit, embodiment) for embodiment in found.embodiments],
        compare_agents(summary),
        study,
        claims(study, summary, audit),
        _spreads(summary),
        fingerprint(audit),
    )


def _spreads(summary: Summary) -> dict[str, Spread]:
    """Variance components of success in the final window, of agents with several runs in a cell."""
    found = {}
    for agent in summary.agents:
        rows = [row for table in summary.tables if (row := table.row_of(agent))]
        cells = [[success_sample(run) for run in row.finished] for row in rows]
        if cells := [runs for runs in cells if len(runs) > 1]:
            found[agent] = spread(cells)
    return found
