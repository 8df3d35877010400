"""Seeds of episodes in training, evaluation, diagnostics and steerability reports.

The ranges do not overlap: steerability is below ``HELD_OUT_SEED``, evaluation begins at it,
diagnostics begin half a million above it, training is from 2^22 to 2^31.
"""

from __future__ import annotations

import numpy as np

from symsteer.leaderboard.records import HELD_OUT_SEED

DIAGNOSTIC_SEED = HELD_OUT_SEED + 500_000
FIRST_TRAINING_SEED = 2**22


def held_out_seeds(count: int) -> list[int]:
    """The first ``count`` evaluation episodes, the same for every agent, variant and run."""
    return [HELD_OUT_SEED + i for i in range(count)]


def diagnostic_seeds(count: int) -> list[int]:
    """The first ``count`` on-policy episodes; Q is compared with their returns."""
    return [DIAGNOSTIC_SEED + i for i in range(count)]


def steerability_seeds(policy_seed: int, states: int) -> list[int]:
    """Initial states of a base policy's steerability report."""
    span = HELD_OUT_SEED // 2
    first = span + states * policy_seed % (span - states)
    return [first + i for i in range(states)]


def training_seeds(run_seed: int, start: int, count: int) -> list[int]:
    """``count`` training episodes, for the ``start``-th fresh start of a run."""
    words = np.random.SeedSequence((run_seed, start)).generate_state(count, np.uint64)
    span = 2**31 - FIRST_TRAINING_SEED
    return [FIRST_TRAINING_SEED + int(word % span) for word in words]
