"""TensorBoard's tab *Custom Scalars*: which charts it has, and what the scalars in them mean.

By default TensorBoard smooths the lines of a multi-line chart, fits the axis to the smoothed
values, and cuts off the 5 % at either end, so that points are missing. It smooths no margin chart.
So what is measured at evaluations, whose points are few and separate, is shown in margin charts
whose margins have no width: lines through all points.
"""

from __future__ import annotations

from collections.abc import Sequence

from tensorboard.plugins.custom_scalar import layout_pb2


def _lines(title: str, *patterns: str) -> layout_pb2.Chart:
    """A chart of the tags that match regular expressions; TensorBoard may smooth its lines."""
    content = layout_pb2.MultilineChartContent(tag=[f"{pattern}$" for pattern in patterns])
    return layout_pb2.Chart(title=title, multiline=content)


def _points(title: str, *tags: str) -> layout_pb2.Chart:
    """A chart of the points of tags, never smoothed.

    TensorBoard warns about runs that lack some of the tags, but not about those that lack one.
    """
    series = [layout_pb2.MarginChartContent.Series(value=t, lower=t, upper=t) for t in tags]
    return layout_pb2.Chart(title=title, margin=layout_pb2.MarginChartContent(series=series))


def _category(title: str, charts: Sequence[layout_pb2.Chart]) -> layout_pb2.Category:
    # TensorBoard shows the margin charts of a category after the others, the last one first.
    lines = [chart for chart in charts if chart.HasField("multiline")]
    points = [chart for chart in charts if chart.HasField("margin")]
    return layout_pb2.Category(title=title, chart=[*lines, *reversed(points)])


LAYOUT = layout_pb2.Layout(
    category=[
        _category(
            "Success",
            [
                _points(
                    "held-out episodes (level line: the frozen base policy)",
                    "eval/success_once",
                    "reference/base_success",
                ),
                _points("training, mean of the last 100 episodes", "train/success_once"),
            ],
        ),
        _category(
            "Q-values",
            [
                _lines("mean, and its feasible bounds", "diag/q_mean", "reference/q_(low|high)"),
                _lines("largest |Q|; feasible up to 1", "(diag|reference)/q_magnitude"),
                _points("bias: Q minus the return", "diag/q_bias"),
                _points("correlation of Q and the return", "diag/q_correlation"),
            ],
        ),
        _category(
            "Equivariance errors, powers of ten (-2: 1 %)",
            [
                _points("of the actor", "log10/equivariance_actor"),
                _points("of the critics", "log10/equivariance_critic"),
            ],
        ),
        _category(
            "Learning",
            [
                _lines("loss of the critics", "losses/critic"),
                _lines("loss of the actor", "losses/actor"),
                _lines("temperature alpha", "train/alpha"),
                _lines("entropy of the actor", "train/entropy"),
            ],
        ),
    ]
)

DESCRIPTIONS = {
    "eval/success_once": "Share of held-out episodes with success at any step.",
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
"""What the tab Scalars says of a scalar; docs/metrics.md has the formulas of all of them."""
