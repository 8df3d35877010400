"""Whether learners are sound: success does not collapse on the way, and Q agrees with returns.

A difference between two agents says something about the agents only if their learner works. The
measures belong to one row of a table, medians over its finished runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from symsteer.leaderboard.cell_names import cell_name
from symsteer.leaderboard.known_agents import BASE
from symsteer.leaderboard.pairs import reference_success
from symsteer.leaderboard.rows import AgentRow, Summary, Table
from symsteer.leaderboard.runs import Run, episode_success
from symsteer.leaderboard.sections import Section, View, one_page
from symsteer.leaderboard.statistics import paired_differences
from symsteer.leaderboard.text import NOTHING, code, compact, number, table_text

MAX_FALL = 0.1
MIN_CORRELATION = 0.8
MAX_BIAS = 0.1
"""Of the feasible interval: with a discount of 0.95, the cost of two decisions."""

EXPLAINED = f"""\
A comparison of agents needs learners that work: success must not collapse on the way, and Q must
agree with the returns of the same decisions. *Fall* is how far success falls below the better of
the untrained agent and the base policy, at most, on the same episodes; *correlation* and *bias* are
those of Q and the return at the end, over all decisions. Medians over runs; sound means a fall of
at most {MAX_FALL:g}, a correlation of at least {MIN_CORRELATION:g}, and a bias of at most
{100 * MAX_BIAS:g} % of the feasible interval."""


@dataclass(frozen=True)
class Soundness:
    """Of the finished runs of one agent in one table; None: not measured.

    Attributes:
        fall: how far success falls below the better of the untrained agent and the base policy.
        worst_fall: the largest one.
        correlation: Pearson's, of Q with the return, at the end.
        bias: absolute difference of mean Q and mean return at the end, reward units.
        bias_share: the same as a share of the feasible interval.
    """

    fall: float | None
    worst_fall: float | None
    correlation: float | None
    bias: float | None
    bias_share: float | None

    @property
    def faults(self) -> list[str]:
        """What is not as it should be."""
        checks = {
            "success falls": self.fall is not None and self.fall > MAX_FALL,
            "Q does not follow returns": self.correlation is not None
            and self.correlation < MIN_CORRELATION,
            "Q is biased": self.bias_share is not None and self.bias_share > MAX_BIAS,
        }
        return [fault for fault, applies in checks.items() if applies]

    @property
    def is_complete(self) -> bool:
        """Whether all three were measured."""
        return None not in (self.fall, self.correlation, self.bias_share)


def soundness(row: AgentRow, table: Table) -> Soundness:
    """The measures of a learner's row."""
    base = table.row_of(BASE)
    references = base.finished if base else []
    falls = [fall for run in row.finished if (fall := _fall(run, references)) is not None]
    biases = [(abs(bias), run) for run in row.finished if (bias := run.last("q_bias")) is not None]
    shares = [
        bias / (feasible.high - feasible.low)
        for bias, run in biases
        if (feasible := run.record.feasible_q)
    ]
    correlations = [v for run in row.finished if (v := run.last("q_correlation")) is not None]
    return Soundness(
        _median(falls),
        max(falls, default=None),
        _median(correlations),
        _median([bias for bias, _ in biases]),
        _median(shares),
    )


def _fall(run: Run, base: Sequence[Run]) -> float | None:
    """Largest fall of a run below its start or its base policy, on the same episodes."""
    first, *later = run.curve.values()
    starts = [episode_success(first), reference_success(run, base)]
    falls = [
        float(np.mean(list(differences.values())))
        for evaluation in later
        for start in starts
        if (differences := paired_differences(start, episode_success(evaluation)))
    ]
    return max(0.0, *falls) if falls else None


def _median(values: Sequence[float]) -> float | None:
    return float(np.median(values)) if values else None


def render(learners: Sequence[tuple[Table, AgentRow, Soundness]], view: View) -> list[str]:
    """Whether each learner is sound in each cell; empty where no success was measured twice."""
    rows = [
        {
            "Cell": cell_name(table, view.summary),
            "Agent": code(row.label),
            "Runs": str(len(row.finished)),
            "Fall": f"{number(sound.fall)} (worst {number(sound.worst_fall)})",
            "Correlation": number(sound.correlation),
            "Bias (reward)": compact(sound.bias),
            "Verdict": ", ".join(sound.faults) or ("sound" if sound.is_complete else NOTHING),
        }
        for table, row, sound in learners
        if sound.fall is not None
    ]
    return [EXPLAINED, table_text(rows, left=2)] if rows else []


def of_learners(summary: Summary) -> list[tuple[Table, AgentRow, Soundness]]:
    """The soundness of every learner's row."""
    return [
        (table, row, soundness(row, table)) for table in summary.tables for row in table.learners
    ]


TITLE = "Are the learners sound"

SECTION = Section(
    TITLE,
    lambda findings: of_learners(findings.summary),
    render,
    apart=one_page("soundness", TITLE, render),
)
