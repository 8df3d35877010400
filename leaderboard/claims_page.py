"""Declared claims as markdown: effects, p-values, verdicts; and what became of the paper's."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

from symsteer.leaderboard.claims import SLOPE_UNIT, Outcome, where
from symsteer.leaderboard.findings import Findings
from symsteer.leaderboard.power import POWER, needed
from symsteer.leaderboard.study import Claim
from symsteer.leaderboard.summary import MIN_SEEDS
from symsteer.leaderboard.text import NOTHING, SPACE, code, compact, number, stacked
from symsteer.tables import markdown

CLAIMS = f"""\
Effects are differences of two agents, paired by base policy and seed (success and its area by
episode, too), mean over cells with {MIN_SEEDS} pairs; slopes are per {SLOPE_UNIT:g} of defect,
within base policies. *Supported* and *contradicted* need p < 0.05 for "no effect", *equivalent*
needs it for "an effect of at least the smallest one of interest"; otherwise a claim is *undecided*.
Both p-values are corrected for the number of tests of a family (Holm), the intervals are not.
"""

PAPER = f"""\
What the paper says (Equi-DSRL, arXiv 2512.11345), and what the runs of this leaderboard say about
it. Each statement is tested by claims that a study declares; p-values are corrected for the number
of tests of a family (Holm). *What it would take*: how many times as many base policies find the
smallest effect of interest with a power of {POWER:g}, if there is one, or show that the effect is
smaller, if it is as measured; below 1 these runs were enough.
"""

PAPER_TITLE = """\
# The paper's claims

This page is generated from run records by `symsteer report`; do not edit it.
"""

MEASURE_WORDS = {
    "auc": "area under the curve",
    "success": "success",
    "diverged": "share of diverged runs",
    "magnitude": "largest \\|Q\\| over the largest feasible",
    "bias": "\\|Q bias\\| (reward)",
}


def claims_section(findings: Findings) -> list[str]:
    """The study's claims and their verdicts, as blocks of markdown."""
    study = findings.study
    origin = f"They are declared in {code(study.source)} (sha256 {code(study.sha256[:12])}"
    if study.declared:
        origin += f", commit {code(study.declared)})."
    else:
        origin += "). The study names no commit that declared them before its runs."
    rows: list[list[str]] = []
    untested: dict[str, list[str]] = {}
    for outcome in findings.claims:
        claim, effect = outcome.claim, outcome.effect
        if effect is None:
            untested.setdefault(outcome.reason, []).append(title(claim))
            continue
        rows.append(
            [
                f"{title(claim)} ({claim.family})",
                _test(claim),
                stacked(effect.interval(), sign=True, digits=3)
                + (f"<br>{outcome.counts}" if outcome.counts else ""),
                f"{claim.smallest:g}",
                NOTHING if outcome.reason else f"{_p(outcome.p)}<br>{_p(outcome.p_equal)}",
                f"{outcome.cells}, {outcome.pairs}, {outcome.policies}",
                _verdict(outcome),
            ]
        )
    parts = [origin]
    if rows:
        header = [
            "Claim (family)",
            "Effect",
            "Size, 95 % interval",
            "Smallest of interest",
            "p: none; at least that",
            "Cells, pairs, policies",
            "Verdict",
        ]
        parts.append(markdown(header, rows, left=2))
    if untested:
        lines = [f"- {reason}: {'; '.join(names)}" for reason, names in untested.items()]
        parts.append("Not tested:\n\n" + "\n".join(lines))
    return parts


def title(claim: Claim) -> str:
    """Its name, and that it predicts no effect where it does: the name may sound otherwise."""
    return f"{claim.name} (predicted: no effect)" if claim.predicted == 0 else claim.name


def _verdict(outcome: Outcome) -> str:
    text = f"**{outcome.verdict}**"
    if outcome.reason:
        return f"{text}: {outcome.reason}"
    if outcome.policies >= MIN_SEEDS or outcome.verdict == "undecided":
        return text
    policies = "one base policy" if outcome.policies == 1 else f"{outcome.policies} base policies"
    return f"{text}, for {policies} alone"


def _test(claim: Claim) -> str:
    first, second = map(code, claim.agents)
    text = f"{MEASURE_WORDS[claim.measure]}, {first} minus {second}, {where(claim.cells)}"
    if claim.minus is not None:
        text += f" minus the same in {where(claim.minus)}"
    return f"slope of {text}" if claim.effect == "slope" else text


def _p(value: float) -> str:
    return "< 0.001".replace(" ", SPACE) if value < 0.001 else number(value, 3)


def paper_page(findings: Findings) -> str:
    """What became of the paper's statements, as a page; empty if the study names none."""
    if not findings.study.statements:
        return ""
    link = "All claims and results are on the [leaderboard](LEADERBOARD.md)."
    parts = [PAPER_TITLE.strip(), link, "## Statements", *paper_section(findings)]
    return "\n\n".join(parts) + "\n"


def paper_section(findings: Findings) -> list[str]:
    """The paper's statements, each with its tests, as blocks of markdown."""
    tests = Counter(o.claim.family for o in findings.claims if not o.reason)
    own = statements(findings)
    overall = [[text, standing(found)] for text, found in own.items()]
    parts = [PAPER.strip(), markdown(["The paper says", "These runs say"], overall, left=2)]
    header = ["Claim", "Effect", "Size, 95 % interval", "p", "Verdict", "What it would take"]
    for text, found in own.items():
        rows = [
            [
                title(outcome.claim),
                _test(outcome.claim),
                stacked(outcome.effect.interval() if outcome.effect else None, True, digits=3),
                NOTHING if outcome.reason else _p(outcome.p),
                _verdict(outcome),
                _needed(outcome, tests[outcome.claim.family]),
            ]
            for outcome in found
        ]
        parts += [f"### {text}", markdown(header, rows, left=2)]
    return parts


def statements(findings: Findings) -> dict[str, list[Outcome]]:
    """The paper's statements, each with what became of the claims that test it."""
    outcomes = {outcome.claim.name: outcome for outcome in findings.claims}
    return {
        each.says: [outcomes[name] for name in each.claims] for each in findings.study.statements
    }


def standing(outcomes: Sequence[Outcome]) -> str:
    """The verdict of several claims: one word if they agree, else how often each was found."""
    found = Counter(outcome.verdict for outcome in outcomes)
    if len(found) == 1:
        return f"**{next(iter(found))}**"
    return ", ".join(f"{count} {verdict}" for verdict, count in found.most_common())


def _needed(outcome: Outcome, tests: int) -> str:
    found = needed(outcome, tests)
    if found is None or outcome.verdict != "undecided":
        return NOTHING
    smallest = f"{outcome.claim.smallest:g}"
    text = f"{_times(found.to_find)} to find {smallest}"
    if found.to_exclude is not None:
        text += f"<br>{_times(found.to_exclude)} to show that it is below"
    return text


def _times(value: float) -> str:
    return f"{compact(value)} times"
