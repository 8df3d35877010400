"""The page's first screen: what symmetry gains, learners at a glance, what became of the claims."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from symsteer.leaderboard.answer import Gain, Tally, against_references, against_standard
from symsteer.leaderboard.claims_page import standing, statements, title
from symsteer.leaderboard.findings import Findings
from symsteer.leaderboard.paper import STANDARD
from symsteer.leaderboard.summary import MIN_SEEDS, Summary
from symsteer.leaderboard.text import (
    MARKS,
    NOTHING,
    SPACE,
    code,
    difference,
    ends,
    folded,
    image,
    interval,
    share,
    without_empty,
)
from symsteer.tables import markdown

ANSWER = f"""\
Advantage over `{STANDARD}` by what breaks the symmetry, with 95 % intervals. In brackets: the
*defect*, how differently the world answers to turned copies of a decision.
"""

GLANCE = f"""\
In how many cells a learner's final success is clearly above (\u25b2) and clearly below (\u25bc)
that of `{STANDARD}`, and that of the best reference, the frozen policy alone. The last column says
in how many of all its runs Q diverged.
"""

MARKED = f"""\
Means over cells of the difference in the area under the success curve (AUC) and in success (final
window), paired by base policy and episode. The defect is that of an audit, from the smallest to the
largest of these cells. \u25b2 and \u25bc: the interval excludes 0, in cells with {MIN_SEEDS} pairs.
"""


def answer_section(
    summary: Summary, findings: Findings, figures: Mapping[str, tuple[str, str]]
) -> list[str]:
    """The picture of what symmetry gains, its numbers (folded), learners at a glance, verdicts."""
    parts = []
    if gained := gains_section(findings):
        explained, *numbers = gained
        drawn = [image(*figures["answer"])] if "answer" in figures else []
        parts += ["## What symmetry gains", explained, *drawn]
        parts += folded("The picture's numbers", numbers)
    if tallies := _glance(summary):
        parts += ["## At a glance", GLANCE.strip(), tallies]
    verdicts = _verdicts(findings)
    return [*parts, *(["## Verdicts", verdicts] if verdicts else [])]


def _glance(summary: Summary) -> str:
    """The table of learners, in the page's order; empty if no cell has enough pairs of runs."""
    rivals = {
        f"Against {code(STANDARD)}": against_standard(summary),
        "Against the best reference": against_references(summary),
    }
    if not any(rivals.values()):
        return ""
    diverged = {agent: flags for agent, flags in _diverged(summary).items() if flags}
    columns = {"Learner": [code(agent) for agent in diverged]}
    for name, tallies in rivals.items():
        columns[name] = [_counts(tallies.get(agent)) for agent in diverged]
    columns["Q diverged"] = [share(sum(flags), len(flags)) for flags in diverged.values()]
    return markdown(*without_empty(columns), left=1)


def _diverged(summary: Summary) -> dict[str, list[bool]]:
    """Of all runs of each agent with a critic, whether Q diverged."""
    flags: dict[str, list[bool]] = {agent: [] for agent in summary.agents}
    for table in summary.tables:
        for row in table.trusted:
            flags[row.agent] += row.diverged
    return flags


def _counts(found: Tally | None) -> str:
    if found is None:
        return NOTHING
    return f"{found.above}{MARKS[1]} {found.below}{MARKS[-1]} of {found.cells}".replace(" ", SPACE)


def gains_section(findings: Findings) -> list[str]:
    """What is shown, what marks mean, and the table; empty if no runs can be paired."""
    found = findings.gains
    return [ANSWER.strip(), MARKED.strip(), _gains_table(found)] if found else []


def _gains_table(found: Sequence[Gain]) -> str:
    agents = list(dict.fromkeys(gain.agent for gain in found))
    texts: dict[str, dict[str, list[str]]] = {}
    cells: dict[str, int] = {}
    defects = {gain.kind: gain.defects for gain in found}
    for gain in found:
        text = difference(gain.effect) if gain.enough else interval(gain.effect, sign=True)
        texts.setdefault(gain.kind, {}).setdefault(gain.agent, []).append(text)
        cells[gain.kind] = max(gain.cells, cells.get(gain.kind, 0))
    rows = [
        [
            kind,
            ends(defects[kind]).replace(" ", SPACE),
            str(cells[kind]),
            *("<br>".join(own.get(agent, [NOTHING])) for agent in agents),
        ]
        for kind, own in texts.items()
    ]
    header = [f"{code(agent)}: AUC,<br>success" for agent in agents]
    return markdown(["World", "Defect", "Cells", *header], rows, left=1)


def _verdicts(findings: Findings) -> str:
    """What became of the paper's statements, or else of all claims by name, as a list."""
    if said := statements(findings):
        lines = [f"- {text}: {standing(outcomes)}." for text, outcomes in said.items()]
        return "\n".join(lines) + "\n\nEach with its tests: [the paper's claims](PAPER.md)."
    named: dict[str, list[str]] = {}
    for outcome in findings.claims:
        named.setdefault(outcome.verdict, []).append(title(outcome.claim))
    order = ("supported", "contradicted", "equivalent", "undecided", "not tested")
    return "\n".join(
        f"- **{verdict.capitalize()}** ({len(named[verdict])}): {'; '.join(named[verdict])}."
        for verdict in order
        if verdict in named
    )
