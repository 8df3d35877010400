"""Whether learners are sound: success does not collapse on the way, and Q agrees with returns.

A difference between two agents says something about the agents only if their learner works. The
measures belong to one row of a table, medians over its finished runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from symsteer.leaderboard.paper import BASE
from symsteer.leaderboard.statistics import paired_differences
from symsteer.leaderboard.summary import Row, Run, Table, episode_success, reference_success

MAX_FALL = 0.1
MIN_CORRELATION = 0.8
MAX_BIAS = 0.1
"""Of the feasible interval: with a discount of 0.95, the cost of two decisions."""


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
        return [fault for fault, found in checks.items() if found]

    @property
    def is_complete(self) -> bool:
        """Whether all three were measured."""
        return None not in (self.fall, self.correlation, self.bias_share)


def soundness(row: Row, table: Table) -> Soundness:
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
