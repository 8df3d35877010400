"""How to read the tables of cells: every column, mark and curve."""

from __future__ import annotations

from symsteer.leaderboard.figures import MANY
from symsteer.leaderboard.records import MAX_GROWTH, MAX_OVERSHOOT
from symsteer.leaderboard.row_numbers import THRESHOLD
from symsteer.leaderboard.rows import MIN_SEEDS, Summary
from symsteer.leaderboard.sections import Section, View

READING = f"""\
Each agent steers a frozen diffusion policy by choosing the noise that it starts from. References
are what learners are compared with, and are never ranked: `base` draws the noise at random, `zero`
sets it to 0, `golden-ticket` is the best constant noise that a search found. Learning is worth its
steps where a learner beats the best reference. All agents of a table share the task, the
demonstrations, the budget and the held-out episodes.

- **Success** is `success_once` in the final window: all held-out evaluations in the last fifth of
  the budget, their episodes pooled (a reference is evaluated once). Shown are the interquartile
  mean (IQM) over base policies and its 95 % interval. The interval draws base policies, each with
  all its runs, or the runs of a cell with one base policy; and it draws episodes, each for all runs
  at once, because all are scored on the same initial states. Of fewer than 4 the IQM is the plain
  mean. **Last** is the same for the final evaluation alone. No number is the best of
  several evaluations. Below each table is the change of success *from the fourth to the last fifth
  of the budget*: an agent with ▲ there was still improving, and more steps may change its place.
- **Against base** is the mean difference (not the IQM's) to the base policy on the same episodes
  and seeds, with its 95 % interval. ▲ or ▼ marks an interval that excludes 0; without a mark the
  data do not decide.
- **Rank** is 1 + the number of learners that are clearly better, by the same paired differences;
  "=" marks a tie. It needs {MIN_SEEDS} finished seeds in common; agents with fewer,
  references and controls have no rank.
- **AUC** is the area under the success curve as a share of the budget's maximum: how good the
  agent was on average while it learned. **Steps** is the median number of environment steps after
  which success stays at or above {100 * THRESHOLD:.0f} % of the best learner's, and how many seeds
  reached that; `>` means that the median seed did not reach it within the budget. **Dip** is the
  lowest value below the base policy at any evaluation of any seed.
- **Q diverged** (†) counts the seeds whose largest |Q| exceeded the largest feasible
  one after learning had begun, whose Q-values grew out of the feasible interval (|Q| {MAX_GROWTH:g}
  times as large at the end as in the middle, and {MAX_OVERSHOOT:g} of the interval outside), or
  were not finite.
- In **learning curves**, thick lines are the IQM (success) or the mean (Q), bands the 95 % interval
  of the IQM, thin lines single runs, dotted lines with a cross unfinished runs. References are
  horizontal lines that start where their search ended. The green area shows the returns that the
  reward allows; a cross there ends a run whose Q was not finite. With {MANY} learners or more,
  bands of learners and single runs are left out.
- Statistics use finished runs. Failed, interrupted, running and missing ones are counted under
  **Status**. The seeds below the number of seeds and episodes are links to the records."""

FROM_FIRST_UPDATE = """\
Here areas (AUC) begin with the first update: the warm-up, in which nothing is learned, does not
count."""
"""Shown only where it is so."""

MADE_AGAIN = """\
Some runs were made again from their records (`symsteer reproduce`); **Status** counts them.
*Reproduced exactly*: every episode and every measured number agrees. *Reproduced alike*: the 95 %
interval of the difference in final success includes 0."""
"""Shown only where it is so."""

SUBMITTED = """\
Rows that are marked *not reproduced* hold submitted runs that no maintainer has made again. They
have no rank, come last in their tables, and nothing is concluded from them."""
"""Shown only where it is so."""


def render(summary: Summary, view: View) -> list[str]:
    """How to read the page."""
    shown = {
        READING: True,
        FROM_FIRST_UPDATE: view.findings.study.area_from == "first update",
        MADE_AGAIN: summary.has_reproductions,
        SUBMITTED: summary.has_marks,
    }
    return [text for text, is_so in shown.items() if is_so]


SECTION = Section("How to read it", lambda findings: findings.summary, render)
