"""The page's first screen: what symmetry gains by kind of break, and what became of the claims."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from symsteer.leaderboard.answer import Gain
from symsteer.leaderboard.claims_page import standing, statements
from symsteer.leaderboard.findings import Findings
from symsteer.leaderboard.paper import STANDARD
from symsteer.leaderboard.summary import MIN_SEEDS
from symsteer.leaderboard.text import (
    NOTHING,
    SPACE,
    code,
    difference,
    folded,
    grid,
    image,
    interval,
    number,
)

ANSWER = f"""\
Advantage over `{STANDARD}` by what breaks the symmetry: mean over cells of the difference in
success (final window) and in the area under its curve, paired by base policy and episode, with 95 %
intervals. The *defect* is how differently the world answers to turned copies of a decision: the
smallest and the largest of these cells.
"""

MARKED = f"""\
\u25b2 and \u25bc: the interval excludes 0, in cells with {MIN_SEEDS} pairs of runs.
"""


def answer_section(findings: Findings, figures: Mapping[str, tuple[str, str]]) -> list[str]:
    """The picture of what symmetry gains, its numbers, folded, and what became of the claims."""
    parts = []
    if gained := gains_section(findings):
        explained, *numbers = gained
        drawn = [image(*figures["answer"])] if "answer" in figures else []
        parts += ["## What symmetry gains", explained, *drawn]
        parts += folded("The picture's numbers", numbers)
    verdicts = _verdicts(findings)
    return [*parts, *(["## Verdicts", verdicts] if verdicts else [])]


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
            kind + _defects(defects[kind]),
            str(cells[kind]),
            *("<br>".join(own.get(agent, [NOTHING])) for agent in agents),
        ]
        for kind, own in texts.items()
    ]
    header = [f"{code(agent)}: AUC,<br>success" for agent in agents]
    return grid(["World", "Cells", *header], rows, left=1)


def _defects(found: tuple[float, float] | None) -> str:
    if found is None:
        return ""
    ends = " to ".join(dict.fromkeys(number(defect) for defect in found))
    return f"<br>defect {ends}".replace(" ", SPACE)


def _verdicts(findings: Findings) -> str:
    """What became of the paper's statements, or else of all claims by name, as a list."""
    if said := statements(findings):
        lines = [f"- {text}: {standing(outcomes)}." for text, outcomes in said.items()]
        return "\n".join(lines) + "\n\nEach with its tests: [the paper's claims](PAPER.md)."
    named: dict[str, list[str]] = {}
    for outcome in findings.claims:
        named.setdefault(outcome.verdict, []).append(outcome.claim.name)
    order = ("supported", "contradicted", "equivalent", "undecided", "not tested")
    return "\n".join(
        f"- **{verdict.capitalize()}** ({len(named[verdict])}): {'; '.join(named[verdict])}."
        for verdict in order
        if verdict in named
    )
