"""The figure of a comparison: a row for each cell, with the differences and their intervals."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from symsteer.leaderboard.compare.changes import DECISIVE, Change, Changes
from symsteer.leaderboard.compare.output import cell_names
from symsteer.leaderboard.compare.sides import Side
from symsteer.leaderboard.figures import by_rows
from symsteer.leaderboard.plots import GREY, Axis, Dot, Figure, Look, Rule, cut
from symsteer.leaderboard.rows import MIN_SEEDS
from symsteer.leaderboard.svg import to_image

TITLES = {"success": "success in the final evaluation", "auc": "area under the success curve"}
LOOKS = {
    "clearly below 0": Look("#D55E00", "v", width=1.8, size=6.5),
    "interval contains 0": Look(GREY, "o", width=1.8, size=6.5),
    "clearly above 0": Look("#0072B2", "^", width=1.8, size=6.5),
}
"""By the meaning of an interval, in the order of its sign: they differ in print, too."""
HOLLOW = f"hollow: fewer than {MIN_SEEDS} pairs"


def picture(a: Side, b: Side, changes: Changes, path: Path) -> bytes:
    """The figure as the content of a file with the suffix of `path`, `.svg` or `.png`."""
    return to_image(described(a, b, changes), path.suffix.lower()[1:])


def described(a: Side, b: Side, changes: Changes) -> Figure:
    """Plots for success and AUC: cells from top to bottom, the mean over them below a line."""
    labels = [cut(name, 60) for name in cell_names(changes.cells)]
    rows = [changed.measures for changed in changes.cells]
    rules = [Rule(-changes.margin, is_vertical=True, dash=":")] if changes.margin else []
    if len(rows) > 1:
        rules.append(Rule(len(rows) - 0.5))
        labels.append("mean over cells")
        rows.append(changes.overall)
    columns = {
        TITLES[name]: [_dot(height, row[name]) for height, row in enumerate(rows) if name in row]
        for name in DECISIVE
        if name in changes.overall
    }
    legend = dict(LOOKS)
    if any(dot.look.hollow for dots in columns.values() for dot in dots):
        legend[HOLLOW] = Look(GREY, "o", "none", size=6.5, hollow=True)
    if changes.margin:
        legend["margin"] = Look("#333333", dash=":", width=0.9)
    figure = by_rows(labels, columns, Axis("B - A, 95 % interval"), undecided=0)
    return replace(
        figure,
        plots=[replace(plot, rules=[*plot.rules, *rules]) for plot in figure.plots],
        legend=legend,
        title=f"A: {_end(a.name)}\nB: {_end(b.name)}",
        height=1.9 + 0.3 * len(rows),
        legend_columns=4,
    )


def _end(name: str, limit: int = 90) -> str:
    """The end of a name, which tells paths apart."""
    return cut(name if len(name) <= limit else f"...{name[3 - limit :]}", limit)


def _dot(height: int, change: Change) -> Dot:
    meaning = list(LOOKS)[1 + (change.difference.sign if change.counts else 0)]
    look = replace(LOOKS[meaning], hollow=not change.counts)
    return Dot(meaning, change.difference, height, look)
