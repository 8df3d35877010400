"""The figure of a comparison: a row for each cell, with the differences and their intervals."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

from matplotlib import style as mpl_style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator

from symsteer.leaderboard.compare.changes import DECISIVE, Change, Changes
from symsteer.leaderboard.compare.output import cell_names
from symsteer.leaderboard.compare.sides import Side
from symsteer.leaderboard.figures import SHEETS, plain, to_svg
from symsteer.leaderboard.summary import MIN_SEEDS

TITLES = {"success": "success in the final evaluation", "auc": "area under the success curve"}
LOOKS = {
    -1: ("#D55E00", "v", "clearly below 0"),
    0: ("#555555", "o", "interval contains 0"),
    1: ("#0072B2", "^", "clearly above 0"),
}
"""Colour, marker and meaning by the sign of an interval: they differ in print, too."""
DOTS_PER_INCH = 160
"""Of a PNG."""


def picture(a: Side, b: Side, changes: Changes, path: Path) -> bytes:
    """The figure as the content of a file with the suffix of `path`, `.svg` or `.png`."""
    with mpl_style.context(SHEETS):
        figure = draw(a, b, changes)
        if path.suffix.lower() == ".svg":
            return to_svg(figure)
        buffer = io.BytesIO()
        figure.savefig(buffer, format="png", dpi=DOTS_PER_INCH, metadata={"Software": None})
    return buffer.getvalue()


def draw(a: Side, b: Side, changes: Changes) -> Figure:
    """Panels for success and AUC: cells from top to bottom, the mean over them below a line."""
    measures = [name for name in DECISIVE if name in changes.overall]
    names = cell_names(changes.cells)
    labels = [plain(" ".join(name), 60) for name in names]
    rows = [found.measures for found in changes.cells]
    if len(rows) > 1:
        labels.append("mean over cells")
        rows.append(changes.overall)
    figure = Figure(figsize=(9.0, 1.9 + 0.3 * len(rows)), layout="constrained")
    axes = list(figure.subplots(1, len(measures), squeeze=False, sharey=True).flat)
    for ax, measure in zip(axes, measures, strict=True):
        ax.axvline(0, color="#333333", linewidth=0.9, zorder=1)
        if changes.margin:
            ax.axvline(-changes.margin, color="#333333", linewidth=0.9, linestyle=":", zorder=1)
        if len(changes.cells) > 1:
            ax.axhline(len(changes.cells) - 0.5, color="#999999", linewidth=0.8, zorder=1)
        for height, row in enumerate(rows):
            if measure in row:
                _draw_change(ax, height, row[measure])
        ax.set_title(TITLES[measure])
        ax.set_xlabel("B - A, 95 % interval")
        ax.margins(x=0.08)
        ax.xaxis.set_major_locator(MaxNLocator(5, steps=[1, 2, 5, 10]))
    axes[0].set_yticks(range(len(rows)), labels)
    axes[0].set_ylim(len(rows) - 0.5, -0.5)
    title = f"A: {_end(a.name)}\nB: {_end(b.name)}"
    figure.suptitle(title, fontsize=10, fontweight="bold")
    figure.legend(handles=_legend(changes), loc="outside lower center", ncols=4, frameon=False)
    return figure


def _end(name: str, limit: int = 90) -> str:
    """The end of a name, which tells paths apart."""
    return plain(name if len(name) <= limit else f"...{name[3 - limit :]}", limit)


def _draw_change(ax: Axes, height: int, change: Change) -> None:
    found = change.difference
    color, marker, _ = LOOKS[found.sign if change.counts else 0]
    ax.plot([found.low, found.high], [height] * 2, color=color, linewidth=1.8)
    face = color if change.counts else "white"
    ax.plot(found.value, height, marker, color=color, markersize=6.5, markerfacecolor=face)


def _legend(changes: Changes) -> list[Line2D]:
    handles = [
        Line2D([], [], color=color, marker=marker, markersize=6.5, label=meaning)
        for color, marker, meaning in LOOKS.values()
    ]
    drawn = [found.measures.get(name) for found in changes.cells for name in DECISIVE]
    if any(change and not change.counts for change in drawn):
        hollow: dict[str, Any] = {"marker": "o", "markerfacecolor": "white", "linestyle": "none"}
        label = f"hollow: fewer than {MIN_SEEDS} pairs"
        handles.append(Line2D([], [], color="#555555", markersize=6.5, label=label, **hollow))
    if changes.margin:
        label = "margin"
        handles.append(Line2D([], [], color="#333333", linewidth=0.9, linestyle=":", label=label))
    return handles
