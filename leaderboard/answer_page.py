"""The page's first screen: what symmetry gains by kind of break, and what became of the claims."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from symsteer.leaderboard.answer import Gain, gains
from symsteer.leaderboard.findings import Findings
from symsteer.leaderboard.paper import STANDARD
from symsteer.leaderboard.summary import MIN_SEEDS, Summary
from symsteer.leaderboard.text import NOTHING, code, difference, grid, image, interval

ANSWER = f"""\
Advantage over `{STANDARD}` by what breaks the symmetry: mean over cells of the difference in
success (final window) and in the area under its curve, paired by base policy and episode, with 95 %
intervals. \u25b2 and \u25bc: the interval excludes 0, in cells with {MIN_SEEDS} pairs of runs.
"""


def answer_section(
    summary: Summary, findings: Findings, figures: Mapping[str, tuple[str, str]]
) -> list[str]:
    """The picture, the gains by kind of break, and what became of the claims."""
    found = gains(summary)
    parts = []
    if found:
        parts += ["## What symmetry gains", ANSWER.strip()]
        if "answer" in figures:
            parts.append(image(*figures["answer"]))
        parts.append(_gains_table(found))
    verdicts = _verdicts(findings)
    return [*parts, *(["## Verdicts", verdicts] if verdicts else [])]


def _gains_table(found: Sequence[Gain]) -> str:
    agents = list(dict.fromkeys(gain.agent for gain in found))
    texts: dict[str, dict[str, list[str]]] = {}
    cells: dict[str, int] = {}
    for gain in found:
        text = difference(gain.effect) if gain.enough else interval(gain.effect, sign=True)
        texts.setdefault(gain.kind, {}).setdefault(gain.agent, []).append(text)
        cells[gain.kind] = max(gain.cells, cells.get(gain.kind, 0))
    rows = [
        [kind, str(cells[kind]), *("<br>".join(own.get(agent, [NOTHING])) for agent in agents)]
        for kind, own in texts.items()
    ]
    header = [f"{code(agent)}: AUC,<br>success" for agent in agents]
    return grid(["World", "Cells", *header], rows, left=1)


def _verdicts(findings: Findings) -> str:
    """Names of the claims by their verdicts, as a list."""
    named: dict[str, list[str]] = {}
    for outcome in findings.claims:
        named.setdefault(outcome.verdict, []).append(outcome.claim.name)
    order = ("supported", "contradicted", "equivalent", "undecided", "not tested")
    return "\n".join(
        f"- **{verdict.capitalize()}** ({len(named[verdict])}): {'; '.join(named[verdict])}."
        for verdict in order
        if verdict in named
    )
