"""Everything that is computed over all tables together."""

from __future__ import annotations

from dataclasses import dataclass

from symsteer.leaderboard.claims import Claim, claims
from symsteer.leaderboard.comparisons import Comparisons, compare_agents
from symsteer.leaderboard.defects import Audit, DefectMap, defect_map, fingerprint
from symsteer.leaderboard.summary import Summary


@dataclass(frozen=True)
class Findings:
    """The map against the audited defect, comparisons of agents, and the paper's claims."""

    map: DefectMap
    comparisons: Comparisons
    claims: list[Claim]
    audit: str
    """Which audit the defects are from (`fingerprint`)."""


def analyse(summary: Summary, audit: Audit) -> Findings:
    """Compute all findings; the same summary and audit give the same numbers."""
    found = defect_map(summary, audit)
    tests = claims(summary, audit, found)
    return Findings(found, compare_agents(summary), tests, fingerprint(audit))
