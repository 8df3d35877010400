"""What figures of several sections share: the looks of agents, rows of intervals.

The colours are those of Okabe and Ito, which people with colour blindness can tell apart; agents
differ by marker as well.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from symsteer.leaderboard.plots import Axis, Dash, Dot, Figure, Look, Plot, Rule

STYLES: dict[str, tuple[str, str, Dash]] = {
    "base": ("#555555", "", (0, (5, 2))),
    "zero": ("#555555", "", (0, (1, 1.5))),
    "golden-ticket": ("#A8860B", "", (0, (5, 1.5, 1, 1.5))),
    "standard": ("#D55E00", "s", "-"),
    "standard-matched": ("#E69F00", "D", "-"),
    "augmented": ("#CC79A7", "v", "-"),
    "equivariant": ("#0072B2", "o", "-"),
    "residual-pathway": ("#117733", "^", "-"),
    "approximate": ("#009E73", "^", "-"),
    "slow": ("#6A3D9A", "^", "-"),
    "free-bias": ("#B15928", "v", "-"),
    "relaxed": ("#44AA99", "P", "-"),
    "projected": ("#999933", "<", "-"),
    "constrained": ("#332288", "h", "-"),
    "partial": ("#56B4E9", "*", "-"),
    "ensemble": ("#7570B3", "p", "-"),
    "displaced": ("#882255", ">", "-"),
    "residual": ("#8C564B", "d", "-"),
    "best-of-n": ("#EE3377", "X", "-"),
    "best-of-n-kernel": ("#EE3377", "X", (0, (3, 1.5))),
    "wrong-group": ("#000000", "X", (0, (3, 1.5))),
}
"""Colour, marker and line style of an agent, the same in every figure."""

OTHERS: tuple[tuple[str, str, Dash], ...] = (
    ("#56B4E9", "P", "-"),
    ("#882255", "<", "-"),
    ("#332288", "h", "-"),
)
MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "h", "p", "*")
COLORS = tuple(color for color, marker, _ in STYLES.values() if marker)
"""Markers and colours of tasks."""

MEASURE_NAMES = {"auc": "area under the curve", "success": "final success"}

MANY = 8
"""With so many learners a plot has no bands of learners, and no single finished runs."""

SHARE = (-0.02, 1.02)
"""Ends of an axis of shares."""


def look_of(agent: str, **more: Any) -> Look:
    """Colour, marker and line style of an agent, with other parts of the look."""
    color, marker, dash = STYLES.get(agent) or OTHERS[sum(map(ord, agent)) % len(OTHERS)]
    return Look(color, marker, dash, **more)


def by_rows(
    labels: Sequence[str],
    columns: Mapping[str, Sequence[Dot]],
    x: Axis,
    undecided: float | None = None,
    grid: bool = True,
) -> Figure:
    """Intervals in named rows, from top to bottom; plots by their titles stand side by side.

    Those that contain the value `undecided`, at which a rule stands, decide nothing.
    """
    rules = [] if undecided is None else [Rule(undecided, is_vertical=True)]
    y = Axis(labels=labels, grid=grid)
    plots = [Plot(x, y, [], dots, rules, title) for title, dots in columns.items()]
    return Figure(plots, columns=len(plots), same_y=True)
