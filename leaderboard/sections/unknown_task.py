"""Whether advice is right about a task that it does not know: each task is left out in turn."""

from __future__ import annotations

from collections.abc import Sequence

from symsteer.leaderboard.known_agents import BASE, STANDARD, STRICT, ZERO
from symsteer.leaderboard.pairs import MEASURES, SHORT_NAMES
from symsteer.leaderboard.sections import Findings, Section, View
from symsteer.leaderboard.sections.regret import fallback
from symsteer.leaderboard.study import Kind, Probe
from symsteer.leaderboard.text import code, number, share, table_text
from symsteer.leaderboard.which_agent import Lesson, Score, leave_tasks_out, lessons_of

Found = tuple[list[Lesson], list[Score]]

EXPLAINED = f"""\
Would `symsteer advise` have been right about each of these worlds without the runs of its task?
Worlds in which `{STRICT}` minus `{STANDARD}` is clearly above or below 0 are *decided*: a rule
answers, or refuses. *Right of all* counts refusals as errors. The regret is a mean over all worlds;
where the rules refuse, it is that of the fallback."""


def scores(found: list[Score]) -> list[dict[str, str]]:
    """The rows of a table: how the rules would have answered."""
    return [
        {
            "Rule": score.rule,
            "By": SHORT_NAMES[score.measure],
            "Decided": str(score.worlds),
            "Answered": str(score.answered),
            "Right": share(score.right, score.answered),
            "Right of all": share(score.right, score.worlds),
            "Regret": number(score.regret, 3),
        }
        | {f"always {code(agent)}": number(value, 3) for agent, value in score.fixed.items()}
        for score in found
    ]


def verdict(lessons: Sequence[Lesson], rule: Probe | Kind) -> str:
    """Whether a declared rule is right often enough, by both measures."""
    if isinstance(rule, Probe):
        where = (
            f"where the best constant noise gains at least {number(rule.gain, 3)} over the better "
            f"of `{BASE}` and `{ZERO}`"
        )
        worlds = [(one, one.gain.value >= rule.gain) for one in lessons if one.gain]
    else:
        where = f"in worlds with {', '.join(map(code, rule.standard))}"
        worlds = [(lesson, lesson.kind in rule.standard) for lesson in lessons]
    known = ", ".join(map(code, rule.found_on))
    declared = (
        f"Declared before the runs: {where}, `{STANDARD}` is better, elsewhere `{STRICT}`; in at "
        f"least {number(100 * rule.right, 0)} % of the decided worlds"
        f"{f' of tasks on which it was not found (it was on {known})' if known else ''}"
        f"{f', of which there are at least {rule.least}' if rule.least > 1 else ''}."
    )
    new = [(lesson, is_broken) for lesson, is_broken in worlds if lesson.task not in rule.found_on]
    right = [_right(new, measure) for measure in MEASURES]
    enough = [each for each in right if len(each) >= rule.least]
    result = "Supported" if len(enough) == len(right) else "Not tested"
    if any(sum(each) < rule.right * len(each) for each in enough):
        result = "Contradicted"
    text = f"{declared} **{result}**: right in {_shares(right)}."
    if known:
        text += f" Of all tasks: {_shares([_right(worlds, measure) for measure in MEASURES])}."
    return text


def _right(worlds: Sequence[tuple[Lesson, bool]], measure: str) -> list[bool]:
    """Whether a rule is right, in each decided world."""
    return [
        is_broken == (sign < 0) for lesson, is_broken in worlds if (sign := lesson.sign(measure))
    ]


def _shares(right: Sequence[list[bool]]) -> str:
    return " and in ".join(
        f"{share(sum(each), len(each))} by {SHORT_NAMES[measure]}"
        for each, measure in zip(right, MEASURES, strict=True)
    )


def render(found: Found, view: View) -> list[str]:
    """Empty where no task could be left out, and no rule was declared."""
    lessons, scored = found
    study = view.findings.study
    return [
        *(verdict(lessons, rule) for rule in (study.kind, study.probe) if rule),
        *([EXPLAINED, table_text(scores(scored), left=2)] if scored else []),
    ]


def compute(findings: Findings) -> Found:
    """With the safe agent as the fallback, if one is proven."""
    lessons = lessons_of(findings.summary)
    return lessons, leave_tasks_out(lessons, fallback(findings.summary, findings.study.safe))


SECTION = Section("Advice for a task without records", compute, render)
