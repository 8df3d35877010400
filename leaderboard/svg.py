"""Figures as deterministic SVG (and PNG), drawn by matplotlib.

Text is drawn as outlines of matplotlib's own font, so that the same records give the same bytes on
every machine.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import figure as mpl_figure
from matplotlib import style as mpl_style
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

from symsteer.leaderboard.plots import FEASIBLE, GREY, Dot, Figure, Look, Plot, Trace
from symsteer.leaderboard.statistics import Interval
from symsteer.leaderboard.text import SPACE

FEASIBLE_TEXT = "#4F6B2A"

WIDTHS = (5.6, 9.0)
"""Of figures with one column of plots, and with several, in inches."""

WIDEST = 13.3
"""Characters of a line of the legend, per inch."""
HANDLE = 7
"""Characters as wide as the line and the space of one entry."""

MAX_MARKERS = 15

RC: dict[str, Any] = {
    "svg.hashsalt": "symsteer",
    "svg.fonttype": "path",
    "font.family": "DejaVu Sans",
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "axes.titlesize": 9.5,
    "figure.facecolor": "white",
    "axes.facecolor": "white",
    "path.simplify": False,
}
SHEETS: Any = ["default", RC]
"""matplotlib's own defaults first, because a user's matplotlibrc would change the bytes."""

FORMATS: dict[str, dict[str, Any]] = {
    "svg": {"metadata": {"Date": None, "Creator": None}},
    "png": {"metadata": {"Software": None}, "dpi": 160},
}
"""Without dates or versions; the same figure gives the same bytes."""


def to_image(figure: Figure, kind: str = "svg") -> bytes:
    """The figure as the content of a file of a kind of `FORMATS`."""
    buffer = io.BytesIO()
    with mpl_style.context(SHEETS):
        draw(figure).savefig(buffer, format=kind, **FORMATS[kind])
    return buffer.getvalue()


def draw(figure: Figure) -> mpl_figure.Figure:
    """The figure as one of matplotlib's; looks follow the style sheets that are in use."""
    rows = -(-len(figure.plots) // figure.columns)
    size = WIDTHS[figure.columns > 1], figure.height
    drawn = mpl_figure.Figure(figsize=size, layout="constrained")
    shared: dict[str, Any] = {"sharex": figure.same_x, "sharey": figure.same_y}
    grid = drawn.subplots(rows, figure.columns, squeeze=False, **shared)
    for index, ax in enumerate(grid.flat):
        if index >= len(figure.plots):
            ax.set_visible(False)
            continue
        plot = figure.plots[index]
        _draw_plot(ax, plot)
        if index % figure.columns == 0:
            ax.set_ylabel(plain(plot.y.title))
            if plot.y.labels:
                ax.set_yticks(range(len(plot.y.labels)), list(map(plain, plot.y.labels)))
                ax.set_ylim(len(plot.y.labels) - 0.5, -0.5)
        if not figure.same_x or index >= figure.columns * (rows - 1):
            ax.set_xlabel(plain(plot.x.title))
    if figure.title:
        drawn.suptitle(plain(figure.title), fontsize=11, fontweight="bold")
    _draw_legend(drawn, figure)
    return drawn


def _draw_plot(ax: Axes, plot: Plot) -> None:
    if plot.title:
        ax.set_title(plain(plot.title))
    if plot.x.in_steps:
        ax.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
        ax.xaxis.set_major_formatter(FuncFormatter(_thousands))
    for rule in plot.rules:
        line = ax.axvline if rule.is_vertical else ax.axhline
        line(rule.at, color="#333333", linestyle=rule.dash, linewidth=0.9, zorder=1)
    for trace in plot.traces:
        if not trace.detail:
            _draw_trace(ax, trace, plot.is_crowded)
    for dot in plot.dots:
        _draw_dot(ax, dot)
    if plot.feasible:
        color, edge = FEASIBLE.color, FEASIBLE.edge
        ax.axhspan(*plot.feasible, color=color, alpha=0.6, linewidth=0, zorder=0)
        for bound in plot.feasible:
            ax.axhline(bound, color=edge, linewidth=0.9, zorder=1)
    if plot.note:
        corner: dict[str, Any] = {"transform": ax.transAxes, "ha": "right", "va": "bottom"}
        ax.text(0.98, 0.02, plain(plot.note), color=FEASIBLE_TEXT, fontsize=8, **corner)
    if any(trace.remark for trace in plot.traces):
        ax.legend(loc="lower left", fontsize=7.5, frameon=False, handlelength=0)
    if plot.empty and not plot.traces and not plot.dots:
        middle: dict[str, Any] = {"transform": ax.transAxes, "ha": "center"}
        ax.text(0.5, 0.5, plain(plot.empty), color="#777777", **middle)
    if plot.y.scale == "symlog":
        ax.set_yscale("symlog", linthresh=plot.y.linear_to)
    elif plot.y.scale == "log":
        ax.set_yscale("log")
    if plot.x.scale == "log":
        ax.set_xscale("log")
        ax.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        ax.xaxis.set_major_formatter("{x:g}")
        ax.xaxis.set_minor_locator(NullLocator())
    if plot.x.ends:
        ax.set_xlim(plot.x.ends)
    if plot.y.ends:
        ax.set_ylim(plot.y.ends)
    if not plot.y.grid:
        ax.grid(axis="y", visible=False)


def _draw_trace(ax: Axes, trace: Trace, is_crowded: bool) -> None:
    look = trace.look
    if trace.flat:
        level: dict[str, Any] = {"linestyle": look.dash, "linewidth": look.width, "zorder": 1.5}
        ax.hlines(trace.y[0], trace.x[0], trace.x[-1], color=look.color, **level)
        if trace.band:
            band: dict[str, Any] = {"color": look.color, "alpha": trace.band, "linewidth": 0}
            ax.axhspan(trace.low[0], trace.high[0], **band)
        return
    if trace.band and not is_crowded:
        band = {"color": look.color, "alpha": trace.band, "linewidth": 0}
        ax.fill_between(trace.x, trace.low, trace.high, **band)
    every = max(1, len(trace.x) // MAX_MARKERS)
    ax.plot(trace.x, trace.y, markevery=every, alpha=look.alpha, **_line(look))
    if trace.cross and len(trace.x):
        ax.plot(trace.x[-1], trace.y[-1], "x", color=look.color, markersize=trace.cross)
    if trace.remark:
        # An entry of the plot's own legend.
        ax.plot([], [], " ", label=plain(f"{trace.name}: {trace.remark}"))


def _draw_dot(ax: Axes, dot: Dot) -> None:
    look, arms = dot.look, {"xerr": _arms(dot.x)}
    if isinstance(dot.y, Interval):
        arms["yerr"] = _arms(dot.y)
    y = dot.y.value if isinstance(dot.y, Interval) else dot.y
    if dot.thick:
        bar: dict[str, Any] = {"linewidth": 6, "alpha": 0.35, "solid_capstyle": "butt"}
        ax.plot([dot.x.low, dot.x.high], [y, y], color=look.color, **bar)
        marker: dict[str, Any] = {"markersize": look.size, "clip_on": False}
        ax.plot(dot.x.value, y, look.marker, color=look.color, **marker)
    else:
        line = _line(look) | {"elinewidth": look.width, "alpha": look.alpha} | arms
        del line["linewidth"], line["linestyle"]
        ax.errorbar(dot.x.value, y, **line)
    if dot.remark:
        beside: dict[str, Any] = {"ha": "left", "va": "bottom", "fontsize": 7.5}
        ax.text(0.0, y - 0.1, plain(dot.remark), color=GREY, **beside)


def _line(look: Look) -> dict[str, Any]:
    """What matplotlib needs to know for a line, without its opacity."""
    line: dict[str, Any] = {"color": look.color, "marker": look.marker, "markersize": look.size}
    line |= {"linestyle": look.dash, "linewidth": look.width}
    return line | ({"markerfacecolor": "white"} if look.hollow else {})


def _arms(interval: Interval) -> list[list[float]]:
    """Lengths of the error bar below and above the value, not negative by rounding."""
    low, high = interval.value - interval.low, interval.high - interval.value
    return [[max(0.0, low)], [max(0.0, high)]]


def _draw_legend(drawn: mpl_figure.Figure, figure: Figure) -> None:
    """Entries below the plots, in as many columns as fit."""
    entries: dict[str, Line2D | Patch] = {}
    for name, look in figure.legend.items():
        area = Patch(facecolor=look.color, edgecolor=look.edge) if look.edge else None
        entries.setdefault(plain(name), area or Line2D([], [], **_line(look)))
    if not entries:
        return
    names, room = list(entries), WIDEST * drawn.get_figwidth()
    columns = min(figure.legend_columns, len(names))
    while columns > 1 and _legend_width(names, columns) > room:
        columns -= 1
    below: dict[str, Any] = {"loc": "outside lower center", "ncols": columns, "frameon": False}
    drawn.legend(list(entries.values()), names, **below)


def _legend_width(names: Sequence[str], columns: int) -> int:
    """In characters; matplotlib fills column after column, the first ones with one entry more."""
    widths = np.array_split([len(name) for name in names], columns)
    return sum(int(width.max()) + HANDLE for width in widths)


def _thousands(value: float, _position: int | None = None) -> str:
    if abs(value) >= 1e6:
        return f"{value / 1e6:g}M"
    return f"{value / 1e3:g}k" if abs(value) >= 1e3 else f"{value:g}"


def plain(text: str) -> str:
    """Printable ASCII in lines, without `$`, which matplotlib would read as mathematics."""
    text = text.replace(SPACE, " ")
    return "".join(c if c == "\n" or (" " <= c <= "~" and c != "$") else "?" for c in text)
