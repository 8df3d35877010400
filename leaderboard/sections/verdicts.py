"""What became of the paper's statements, or of all claims; and PAPER.md, with their tests."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from scipy.stats import norm

from symsteer.leaderboard.sections import Findings, Section, View, claims
from symsteer.leaderboard.sections.claims import (
    ClaimOutcome,
    p_text,
    size_text,
    test_text,
    title,
    verdict_text,
)
from symsteer.leaderboard.statistics import CONFIDENCE, Interval
from symsteer.leaderboard.text import NOTHING, code, compact, table_text

POWER = 0.8

PAPER_TITLE = """\
# The paper's claims

This page is generated from run records by `symsteer report`; do not edit it.
"""

EXPLAINED = f"""\
What the paper says (Equi-DSRL, arXiv 2512.11345), and what the runs of this leaderboard say about
it. Each statement is tested by claims that a study declares; p-values are corrected for the number
of tests of a family (Holm). *What it would take*: how many times as many base policies find the
smallest effect of interest with a power of {POWER:g}, if there is one, or show that the effect is
smaller, if it is as measured; below 1 these runs were enough."""


def statements(findings: Findings) -> dict[str, list[ClaimOutcome]]:
    """The paper's statements, each with what became of the claims that test it."""
    outcomes = {outcome.claim.name: outcome for outcome in findings.of(claims.SECTION)}
    return {
        each.says: [outcomes[name] for name in each.claims] for each in findings.study.statements
    }


def render(said: dict[str, list[ClaimOutcome]], view: View) -> list[str]:
    """Their verdicts as a list, then those of all other claims by name."""
    outcomes = view.findings.of(claims.SECTION)
    if said:
        lines = [f"- {text}: {standing(tested)}." for text, tested in said.items()]
        meaning = (
            "*Equivalent*: the effect is shown to be smaller than the smallest one of interest."
        )
        told = "Each with its tests: [the paper's claims](PAPER.md)."
        tested = {outcome.claim.name for of in said.values() for outcome in of}
        rest = [outcome for outcome in outcomes if outcome.claim.name not in tested]
        others = ["What else was declared:", _by_verdict(rest)] if rest else []
        return [meaning, "\n".join(lines), told, *others]
    return [_by_verdict(outcomes)] if outcomes else []


def _by_verdict(outcomes: Sequence[ClaimOutcome]) -> str:
    """Names of claims, a line for each verdict."""
    named: dict[str, list[str]] = {}
    for outcome in outcomes:
        name = title(outcome.claim) + _in_brackets(reservations([outcome]))
        named.setdefault(outcome.verdict, []).append(name)
    order = ("supported", "contradicted", "equivalent", "undecided", "not tested")
    lines = [
        f"- **{verdict.capitalize()}** ({len(named[verdict])}): {'; '.join(named[verdict])}."
        for verdict in order
        if verdict in named
    ]
    return "\n".join(lines)


def standing(outcomes: Sequence[ClaimOutcome]) -> str:
    """The verdict of several claims: one word if they agree, else how often each was found.

    And how many of them rest on a task, or do not hold in one.
    """
    verdicts = Counter(outcome.verdict for outcome in outcomes)
    found = ", ".join(f"{count} {verdict}" for verdict, count in verdicts.most_common())
    text = f"**{next(iter(verdicts))}**" if len(verdicts) == 1 else found
    return text + _in_brackets(reservations(outcomes))


def reservations(outcomes: Sequence[ClaimOutcome]) -> list[str]:
    """How many of some claims rest on a task, and how many hold on average, but not in one."""
    resting = [outcome.needs for outcome in outcomes if outcome.needs]
    apart = [outcome.apart for outcome in outcomes if outcome.apart]
    texts = []
    for tasks, words in (
        (resting, "rest on" if len(resting) > 1 else "rests on"),
        (apart, "on average, but not in"),
    ):
        if tasks:
            number = f"{len(tasks)} of {len(outcomes)} " if len(outcomes) > 1 else ""
            named = sorted({task for each in tasks for task in each})
            texts.append(f"{number}{words} {', '.join(map(code, named))}")
    return texts


def _in_brackets(texts: Sequence[str]) -> str:
    return f" ({'; '.join(texts)})" if texts else ""


def paper_page(said: dict[str, list[ClaimOutcome]], view: View) -> str:
    """PAPER.md; empty if the study names no statements."""
    link = "All claims and results are on the [leaderboard](LEADERBOARD.md)."
    blocks = [PAPER_TITLE.strip(), link, "## Statements", *render_tests(said, view)]
    return "\n\n".join(blocks) + "\n" if said else ""


def render_tests(said: dict[str, list[ClaimOutcome]], view: View) -> list[str]:
    """The paper's statements, each with its tests; empty if the study names none."""
    if not said:
        return []
    outcomes = view.findings.of(claims.SECTION)
    tests = Counter(outcome.claim.family for outcome in outcomes if not outcome.reason)
    overall = [
        {"The paper says": text, "These runs say": standing(tested)}
        for text, tested in said.items()
    ]
    parts = [EXPLAINED, table_text(overall, left=2)]
    for text, tested in said.items():
        rows = [
            {
                "Claim": title(outcome.claim),
                "Verdict": verdict_text(outcome),
                "Effect": test_text(outcome.claim),
                "Size, 95 % interval": size_text(outcome),
                "p": NOTHING if outcome.reason else p_text(outcome.p),
                "What it would take": _needed(outcome, tests[outcome.claim.family]),
            }
            for outcome in tested
        ]
        parts += [f"### {text}", table_text(rows, left=3)]
    return parts


def _needed(outcome: ClaimOutcome, tests: int) -> str:
    policies = needed(outcome, tests)
    if policies is None or outcome.verdict != "undecided":
        return NOTHING
    smallest = f"{outcome.claim.smallest:g}"
    text = f"{compact(policies.to_find)} times to find {smallest}"
    if policies.to_exclude is not None:
        text += f"<br>{compact(policies.to_exclude)} times to show that it is below"
    return text


@dataclass(frozen=True)
class NeededPolicies:
    """How many times as many base policies a test needs.

    Attributes:
        to_find: to find the smallest effect of interest, if the effect is that large.
        to_exclude: to show that the effect is smaller, if it is what was measured; None if what was
            measured is not smaller.
    """

    to_find: float
    to_exclude: float | None


def needed(outcome: ClaimOutcome, tests: int) -> NeededPolicies | None:
    """What a tested claim needs for a power of `POWER`; None if it was not tested.

    The standard error is taken from the interval, and falls with the root of the number of base
    policies. Of a family of `tests`, Holm's first step is asked for, which is the hardest.
    """
    if outcome.reason or outcome.effect is None:
        return None
    effect, level = outcome.effect.interval(), (1 - CONFIDENCE) / tests
    margin, error = outcome.claim.smallest, standard_error(effect)
    room = margin - abs(effect.value)
    return NeededPolicies(
        float(((norm.isf(level / 2) + norm.ppf(POWER)) * error / margin) ** 2),
        # Both of the one-sided tests must succeed.
        float(((norm.isf(level) + norm.ppf((1 + POWER) / 2)) * error / room) ** 2)
        if room > 0
        else None,
    )


def standard_error(effect: Interval) -> float:
    """Of a normal distribution with this interval."""
    return (effect.high - effect.low) / 2 / float(norm.isf((1 - CONFIDENCE) / 2))


SECTION = Section("Verdicts", statements, render, where="first")

TESTS = Section(
    "The paper's claims", statements, render_tests, where="site", files={"PAPER.md": paper_page}
)
