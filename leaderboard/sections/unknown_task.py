"""Whether advice is right about a task that it does not know: each task is left out in turn."""

from __future__ import annotations

from symsteer.leaderboard.known_agents import STANDARD, STRICT
from symsteer.leaderboard.pairs import SHORT_NAMES
from symsteer.leaderboard.sections import Findings, Section, View
from symsteer.leaderboard.text import code, number, share, table_text
from symsteer.leaderboard.which_agent import Score, leave_tasks_out, lessons_of

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


def render(found: list[Score], view: View) -> list[str]:
    """Empty where no task could be left out."""
    return [EXPLAINED, table_text(scores(found), left=2)] if found else []


def compute(findings: Findings) -> list[Score]:
    """With the declared safe agent as the fallback, if there is one."""
    safe = findings.study.safe
    return leave_tasks_out(lessons_of(findings.summary), safe.agent if safe else STANDARD)


SECTION = Section("Advice for a task without records", compute, render)
