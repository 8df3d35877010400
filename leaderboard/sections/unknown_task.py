"""Whether advice is right about a task that it does not know: each task is left out in turn."""

from __future__ import annotations

from collections.abc import Sequence

from symsteer.leaderboard.known_agents import BASE, STANDARD, STRICT, ZERO
from symsteer.leaderboard.pairs import MEASURES, SHORT_NAMES
from symsteer.leaderboard.sections import Findings, Section, View
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
        broken = [lesson.gain.value >= rule.gain if lesson.gain else None for lesson in lessons]
    else:
        where = f"in worlds with {', '.join(map(code, rule.standard))}"
        broken = [lesson.kind in rule.standard for lesson in lessons]
    declared = (
        f"Declared before the runs: {where}, `{STANDARD}` is better, elsewhere `{STRICT}`; in at "
        f"least {number(100 * rule.right, 0)} % of the decided worlds."
    )
    texts, holds = [], []
    for measure in MEASURES:
        right = [
            is_broken == (sign < 0)
            for lesson, is_broken in zip(lessons, broken, strict=True)
            if is_broken is not None and (sign := lesson.sign(measure))
        ]
        texts.append(f"{share(sum(right), len(right))} by {SHORT_NAMES[measure]}")
        holds += [sum(right) >= rule.right * len(right)] if right else []
    result = ("Supported" if all(holds) else "Contradicted") if holds else "Not tested"
    return f"{declared} **{result}**: right in {' and in '.join(texts)}."


def render(found: Found, view: View) -> list[str]:
    """Empty where no task could be left out, and no rule was declared."""
    lessons, scored = found
    study = view.findings.study
    return [
        *(verdict(lessons, rule) for rule in (study.kind, study.probe) if rule),
        *([EXPLAINED, table_text(scores(scored), left=2)] if scored else []),
    ]


def compute(findings: Findings) -> Found:
    """With the declared safe agent as the fallback, if there is one."""
    safe, lessons = findings.study.safe, lessons_of(findings.summary)
    return lessons, leave_tasks_out(lessons, safe.agent if safe else STANDARD)


SECTION = Section("Advice for a task without records", compute, render)
