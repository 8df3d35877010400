"""The scalars that TensorBoard describes, and the charts of its tab *Custom Scalars*.

docs/metrics.md has the formulas of all scalars.
"""

from __future__ import annotations

from typing import TypeAlias

Charts: TypeAlias = dict[str, dict[str, tuple[str, ...]]]
"""Tags of scalars by group of charts and title."""

DESCRIPTIONS = {
    "eval/success_once": "Share of held-out episodes with success at any step.",
    "eval/success_at_end": "Share of held-out episodes with success at the last step.",
    "eval/return": "Mean undiscounted return of held-out episodes.",
    "train/success_once": "Share of the last 100 training episodes with success.",
    "train/return": "Mean undiscounted return of the last 100 training episodes.",
    "train/episode_len": "Mean length of the last 100 training episodes, in control steps.",
    "train/alpha": "Entropy weight alpha, mean over the updates since the last point.",
    "train/entropy": "Mean of -log pi(w | s) on training batches, in nats per decision.",
    "reference/base_success": "Success of the frozen base policy with random noise.",
    "reference/q_low": "Lowest discounted return that the reward allows.",
    "reference/q_high": "Highest discounted return that the reward allows.",
    "reference/q_magnitude": "1: larger values belong to no feasible return.",
    "diag/q_mean": "Mean over held-out states of min_j Q_j(s, w), w from the actor.",
    "diag/q_bias": "Mean of Q minus the return, over decisions of fresh episodes.",
    "diag/q_correlation": "Pearson's correlation of Q and the return over these decisions.",
    "diag/q_magnitude": "Largest |Q| over the largest feasible one; above 1: diverged.",
    "diag/td_error": "Root mean square of the temporal-difference error on fresh episodes.",
    "diag/equivariance_actor": "Largest relative difference of mu(gs) and g mu(s) over the group.",
    "diag/equivariance_critic": "Relative standard deviation of Q over the group.",
    "log10/equivariance_actor": "log10 of diag/equivariance_actor; -8 also stands for less.",
    "log10/equivariance_critic": "log10 of diag/equivariance_critic; -8 also stands for less.",
    "losses/critic": "Squared temporal-difference error on training batches, summed over critics.",
    "losses/actor": "Mean of alpha log pi(w | s) - min_j Q_j(s, w) on training batches.",
    "time/env_steps_per_second": "Control steps over all seconds since the start of the run.",
}

FINAL_METRICS = tuple(tag for tag in DESCRIPTIONS if tag.startswith(("eval/", "diag/", "time/")))
"""Columns of the HParams tab: the last value of each of these scalars."""

POINTS: Charts = {
    "Success": {
        "held-out episodes (level line: the frozen base policy)": (
            "eval/success_once",
            "reference/base_success",
        ),
        "training, mean of the last 100 episodes": ("train/success_once",),
    },
    "Q-values": {
        "bias: Q minus the return": ("diag/q_bias",),
        "correlation of Q and the return": ("diag/q_correlation",),
    },
    "Equivariance errors, powers of ten (-2: 1 %)": {
        "of the actor": ("log10/equivariance_actor",),
        "of the critics": ("log10/equivariance_critic",),
    },
}
"""Charts of few and separate points, which are never smoothed."""

LINES: Charts = {
    "Q-values": {
        "mean, and its feasible bounds": ("diag/q_mean", "reference/q_low", "reference/q_high"),
        "largest |Q|; feasible up to 1": ("diag/q_magnitude", "reference/q_magnitude"),
    },
    "Learning": {
        "loss of the critics": ("losses/critic",),
        "loss of the actor": ("losses/actor",),
        "temperature alpha": ("train/alpha",),
        "entropy of the actor": ("train/entropy",),
    },
}
"""Charts whose lines TensorBoard may smooth."""
