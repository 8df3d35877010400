"""The figures as deterministic SVG: the map, profiles, comparisons; learning curves and Q-values.

The colours are those of Okabe and Ito, which people with colour blindness can tell apart; agents
differ by marker as well. Text is drawn as outlines of matplotlib's own font, so that the same
records give the same bytes on every machine.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from textwrap import wrap
from typing import Any

import numpy as np
from matplotlib import style as mpl_style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.ticker import FuncFormatter, MaxNLocator

from symsteer.leaderboard.answer import Gain
from symsteer.leaderboard.comparisons import THRESHOLDS, Comparisons, Profile
from symsteer.leaderboard.curves import mean_series, series, success_curve
from symsteer.leaderboard.defects import MEASURES, DefectMap, Fit, Panel
from symsteer.leaderboard.findings import Findings
from symsteer.leaderboard.paper import BASE, STANDARD
from symsteer.leaderboard.statistics import Interval
from symsteer.leaderboard.summary import MIN_SEEDS, Row, Summary, Table
from symsteer.leaderboard.tables import beside_variant
from symsteer.leaderboard.text import SPACE, ends

Style = tuple[str, str, Any]
"""Color, marker and line style of an agent."""

STYLES: dict[str, Style] = {
    "base": ("#555555", "", (0, (5, 2))),
    "zero": ("#555555", "", (0, (1, 1.5))),
    "golden-ticket": ("#A8860B", "", (0, (5, 1.5, 1, 1.5))),
    "standard": ("#D55E00", "s", "-"),
    "standard-matched": ("#E69F00", "D", "-"),
    "augmented": ("#CC79A7", "v", "-"),
    "equivariant": ("#0072B2", "o", "-"),
    "residual-pathway": ("#117733", "^", "-"),
    "approximate": ("#009E73", "^", "-"),
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
OTHERS: tuple[Style, ...] = (("#56B4E9", "P", "-"), ("#882255", "<", "-"), ("#332288", "h", "-"))
FEASIBLE, FEASIBLE_EDGE, FEASIBLE_TEXT = "#DDE7D0", "#7A9A50", "#4F6B2A"
PLACE_MARKERS = ("o", "s", "^", "D", "v", "P", "X", "<", ">", "h", "p", "*")
"""Markers of the map, one for each task."""

PARTS = {"tool": "#0072B2", "object": "#D55E00", "cost": "#CC79A7", "observation": "#009E73"}
"""Colours of the map: which part of a decision the defect is of."""
FIT = "#444444"

MEASURE_NAMES = {"auc": "area under the curve", "success": "final success"}

COLUMNS = 3
TITLE_WIDTH = 36
"""Characters of a panel's title."""
WIDEST = 13.3
"""Characters of a line of the legend, per inch."""
HANDLE = 7
"""Characters as wide as the line and the space of one entry."""

MAX_MARKERS = 15

MANY = 8
"""With so many learners a panel has no bands of learners, and no single finished runs."""

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


@dataclass(frozen=True)
class Drawing:
    """A figure, what it shows, and where it belongs: (task, embodiment), (embodiment,) or ()."""

    kind: str
    place: tuple[str, ...]
    text: str
    figure: Figure


def render_figures(summary: Summary, findings: Findings) -> list[Drawing]:
    """All figures in the order of the page; figures without data are left out."""
    drawings = []
    places: dict[tuple[str, str], list[Table]] = {}
    for table in summary.tables:
        if table.runs:
            places.setdefault((table.key.task, table.key.embodiment), []).append(table)
    with mpl_style.context(SHEETS):
        if findings.gains:
            text = "Advantage of symmetry over the standard agent, by kind of break"
            drawings.append(Drawing("answer", (), text, answer_chart(findings.gains)))
        for embodiment in findings.map.embodiments:
            text = "Advantage of symmetry against the audited defect"
            figure = advantage_map(findings.map, embodiment)
            drawings.append(Drawing("map", (embodiment,), text, figure))
        if any(findings.comparisons.profiles.values()):
            figure = performance_profiles(findings.comparisons)
            drawings.append(Drawing("profiles", (), "Performance profiles", figure))
        if any(findings.comparisons.improvements.values()):
            figure = improvement_chart(findings.comparisons)
            drawings.append(Drawing("improvement", (), "Probability of improvement", figure))
        for place, tables in places.items():
            text = "Learning curves"
            drawings.append(Drawing("success", place, text, learning_curves(tables)))
            if any(run.record.has_critic for table in tables for run in table.runs):
                text = "Q-values and their feasible band"
                drawings.append(Drawing("q", place, text, q_values(tables)))
    return drawings


def to_svg(figure: Figure) -> bytes:
    """SVG without dates or versions; the same figure gives the same bytes."""
    buffer = io.BytesIO()
    with mpl_style.context(SHEETS):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None})
    return buffer.getvalue()


def learning_curves(tables: Sequence[Table]) -> Figure:
    """Success over environment steps: one panel a table, the IQM over seeds with its 95 % band.

    Thin lines are single seeds, drawn while these are few; those of unfinished runs are dotted and
    end in a cross. References that were evaluated once are horizontal lines. Panels with `MANY`
    learners have no bands of these.
    """
    figure, axes = _panels(tables, "success_once on held-out episodes")
    handles: dict[str, Line2D] = {}
    for ax, table in zip(axes, tables, strict=True):
        ax.set_ylim(-0.02, 1.02)
        for row in table.rows:
            if not row.runs:
                continue
            _draw_success(ax, row, table.key.env_steps, len(table.learners) < MANY)
            handles.setdefault(plain(row.label), _entry(row.agent, markersize=5))
    _legend(figure, handles)
    return figure


def _entry(agent: str, **more: Any) -> Line2D:
    """An agent in the legend."""
    color, marker, line = style_of(agent)
    return Line2D([], [], color=color, marker=marker, linestyle=line, **more)


def _draw_success(ax: Axes, row: Row, budget: int, band: bool) -> None:
    color, marker, line = style_of(row.agent)
    for run in row.runs:
        values = [evaluation.success_once for evaluation in run.curve.values()]
        if run.finished and (row.is_reference or not 1 < len(row.finished) < MIN_SEEDS):
            continue
        dotted: dict[str, Any] = {} if run.finished else {"linestyle": ":"}
        ax.plot(list(run.curve), values, color=color, linewidth=0.7, alpha=0.35, **dotted)
        if not run.finished and values:
            ax.plot(list(run.curve)[-1], values[-1], "x", color=color, markersize=5)
    curve = success_curve(row)
    if not curve.steps:
        return
    if len(curve.steps) == 1 and row.is_reference:
        # From where the search ended; a reference without a search starts at 0.
        start = min(row.search_steps or 0, budget)
        value = curve.values[0]
        ax.hlines(value, start, budget, color=color, linestyle=line, linewidth=1.4, zorder=1.5)
        if row.agent == BASE:
            ax.axhspan(curve.low[0], curve.high[0], color=color, alpha=0.10, linewidth=0)
        return
    if band:
        ax.fill_between(curve.steps, curve.low, curve.high, color=color, alpha=0.14, linewidth=0)
    marks: dict[str, Any] = {"marker": marker, "markersize": 4}
    marks["markevery"] = max(1, len(curve.steps) // MAX_MARKERS)
    ax.plot(curve.steps, curve.values, color=color, linestyle=line, linewidth=1.7, **marks)


def q_values(tables: Sequence[Table]) -> Figure:
    """Mean Q at the actor's own noise against the feasible band of the task's reward.

    Thin lines are single seeds (with `MANY` learners those whose Q is not finite, only), the thick
    line is their mean; hollow markers are the fresh discounted returns that Q should predict. Seeds
    whose Q is not finite end in a cross. The axis turns logarithmic far outside the band.
    """
    figure, axes = _panels(tables, "Q-value (discounted return)")
    handles: dict[str, Line2D | Patch] = {}
    explained: dict[str, Line2D | Patch] = {}
    for ax, table in zip(axes, tables, strict=True):
        extremes: list[float] = []
        for row in table.rows:
            runs = [run for run in row.runs if run.record.has_critic]
            if not runs:
                continue
            color, marker, line = style_of(row.agent)
            for run in runs:
                steps, values = series(run, "q_mean")
                if len(table.learners) < MANY or run.record.nonfinite_q:
                    ax.plot(steps, values, color=color, linewidth=0.8, alpha=0.5)
                extremes += values
                if run.record.nonfinite_q:
                    ax.plot(steps[-1:], values[-1:], "x", color=color, markersize=7)
            places, means = mean_series(runs, "q_mean")
            style: dict[str, Any] = {"color": color, "marker": marker, "markersize": 4}
            style["markevery"] = max(1, len(places) // MAX_MARKERS)
            ax.plot(places, means, linestyle=line, linewidth=1.7, **style)
            returns = mean_series(runs, "return_mean")
            ax.plot(*returns, linestyle="none", markerfacecolor="white", **style)
            extremes += returns[1]
            handles.setdefault(plain(row.label), _entry(row.agent, markersize=5))
            if returns[1]:
                hollow: dict[str, Any] = {"marker": "o", "markerfacecolor": "white"}
                hollow["linestyle"] = "none"
                explained["fresh return"] = Line2D([], [], color="#555555", markersize=5, **hollow)
        if table.feasible:
            _feasible_band(ax, *table.feasible, extremes)
            explained["feasible"] = Patch(facecolor=FEASIBLE, edgecolor=FEASIBLE_EDGE)
        if not extremes:
            ax.text(0.5, 0.5, "no Q-values", transform=ax.transAxes, ha="center", color="#777777")
    _legend(figure, handles | explained)
    return figure


def _feasible_band(ax: Axes, low: float, high: float, values: Sequence[float]) -> None:
    """Shade the feasible band and choose the axis so that both values and bounds can be read."""
    ax.axhspan(low, high, color=FEASIBLE, alpha=0.6, linewidth=0, zorder=0)
    for bound in (low, high):
        ax.axhline(bound, color=FEASIBLE_EDGE, linewidth=0.9, zorder=1)
    span = max(high - low, 1e-6)
    bottom, top = min([high, *values]), max([high, *values])
    if top > high + 4 * span or bottom < low - 4 * span:
        ax.set_yscale("symlog", linthresh=span)
        return
    if values and bottom - low > 2 * (top - bottom):
        # The lower bound is so far away that showing it would flatten the curves.
        corner: dict[str, Any] = {"transform": ax.transAxes, "ha": "right", "va": "bottom"}
        text = f"feasible down to {low:.4g}"
        ax.text(0.98, 0.02, text, color=FEASIBLE_TEXT, fontsize=8, **corner)
        margin = 0.18 * (top - bottom)
    else:
        bottom = min(bottom, low)
        margin = 0.06 * (top - bottom)
    ax.set_ylim(bottom - margin, top + margin)


def advantage_map(found: DefectMap, embodiment: str) -> Figure:
    """Advantage over the standard agent against the audited defect: agents by measures.

    The colour says which part of a decision the defect is of, the marker the task; bars are 95 %
    intervals, hollow points have few runs. A line per task has the slope within base policies and
    goes through the task's mean; the fan around it has the slopes of the 95 % interval.
    """
    agents = found.agents(embodiment)
    figure = Figure(figsize=(9.0, 1.4 + 2.75 * len(agents)), layout="constrained")
    shape = len(agents), len(MEASURES)
    grid = figure.subplots(*shape, sharex=True, sharey=True, squeeze=False)
    panels = [[found.panel(embodiment, a, m) for m in MEASURES] for a in agents]
    points = [point for row in panels for panel in row for point in panel.points]
    tasks = sorted({point.table.key.task for point in points})
    markers = {task: PLACE_MARKERS[i % len(PLACE_MARKERS)] for i, task in enumerate(tasks)}
    right = 1.04 * max(point.defect.interval.high for point in points)
    for axes, row in zip(grid, panels, strict=True):
        for ax, panel in zip(axes, row, strict=True):
            ax.set_xlim(-0.02 * right, right)
            _draw_panel(ax, panel, markers)
            ax.set_title(f"{panel.agent}, {MEASURE_NAMES[panel.measure]}")
        axes[0].set_ylabel(f"advantage over {STANDARD}")
    for ax in grid[-1]:
        ax.set_xlabel(f"audited defect of a decision, {plain(embodiment, 26)}")
    handles: dict[str, Line2D | Patch] = {
        plain(task, 26): Line2D([], [], color="#555555", marker=marker, linestyle="none")
        for task, marker in markers.items()
    }
    parts = {point.defect.part for point in points}
    handles |= {part: Patch(color=color) for part, color in PARTS.items() if part in parts}
    if any(panel.fit for row in panels for panel in row):
        handles["within base policies, 95 %"] = Line2D([], [], color=FIT)
    _legend(figure, handles, columns=4)
    return figure


def _draw_panel(ax: Axes, panel: Panel, markers: Mapping[str, str]) -> None:
    ax.axhline(0, color="#333333", linewidth=0.9, zorder=1)
    if panel.fit:
        _draw_fit(ax, panel.fit)
    for point in panel.points:
        defect, gain = point.defect.interval, point.advantage
        color = PARTS[point.defect.part]
        look: dict[str, Any] = {"color": color, "elinewidth": 0.8, "alpha": 0.85, "markersize": 6}
        look["marker"] = markers[point.table.key.task]
        look["markerfacecolor"] = color if point.counts else "white"
        ax.errorbar(defect.value, gain.value, xerr=_arms(defect), yerr=_arms(gain), **look)
    if not panel.points:
        ax.text(0.5, 0.5, "no paired runs", transform=ax.transAxes, ha="center", color="#777777")


def _arms(interval: Interval) -> list[list[float]]:
    """Lengths of the error bar below and above the value, not negative by rounding."""
    low, high = interval.value - interval.low, interval.high - interval.value
    return [[max(0.0, low)], [max(0.0, high)]]


def _draw_fit(ax: Axes, fit: Fit) -> None:
    slope = fit.slope.interval()
    for line in fit.lines:
        (x, y), ends = line.centre, np.array(line.span)
        grid = np.array([ends[0], x, ends[1]])
        heights = [y + s * (grid - x) for s in (slope.value, slope.low, slope.high)]
        ax.plot(grid, heights[0], color=FIT, linewidth=1.4)
        low, high = np.minimum(*heights[1:]), np.maximum(*heights[1:])
        ax.fill_between(grid, low, high, color=FIT, alpha=0.1, linewidth=0)


def answer_chart(found: Sequence[Gain]) -> Figure:
    """Advantage over the standard agent by kind of break, with 95 % intervals; hollow: few runs.

    In brackets stand the smallest and the largest audited defect of a kind's cells.
    """
    defects = {gain.kind: gain.defects for gain in found}
    kinds = list(defects)
    agents = list(dict.fromkeys(gain.agent for gain in found))
    figure = Figure(figsize=(9.0, 0.9 + 0.28 * len(kinds)), layout="constrained")
    axes = figure.subplots(1, len(MEASURES), sharey=True)
    for ax, measure in zip(axes, MEASURES, strict=True):
        ax.axvline(0, color="#333333", linewidth=0.9, zorder=1)
        for gain in found:
            if gain.measure != measure:
                continue
            color, marker, _ = style_of(gain.agent)
            shift = agents.index(gain.agent) - (len(agents) - 1) / 2
            height = kinds.index(gain.kind) + 0.24 * shift
            look: dict[str, Any] = {"color": color, "elinewidth": 1.2, "markersize": 5}
            look |= {"marker": marker, "markerfacecolor": color if gain.enough else "white"}
            ax.errorbar(gain.effect.value, height, xerr=_arms(gain.effect), **look)
        ax.set_title(f"advantage over {STANDARD}: {MEASURE_NAMES[measure]}")
        ax.grid(axis="y", visible=False)
    labels = [_with_defects(kind, own) for kind, own in defects.items()]
    axes[0].set_yticks(range(len(kinds)), labels)
    axes[0].set_ylim(len(kinds) - 0.5, -0.5)
    _legend(figure, {plain(agent, 26): _entry(agent) for agent in agents})
    return figure


def _with_defects(kind: str, defects: tuple[float, float] | None) -> str:
    """A kind of break without its marks of code, and the audited defects of its cells."""
    text = plain(kind.replace("`", ""), 44)
    return f"{text} ({ends(defects)})" if defects else text


def performance_profiles(found: Comparisons) -> Figure:
    """Share of runs that close at least a share of the gap to certain success, with 95 % bands."""
    groups = [group for group, profiles in found.profiles.items() if profiles]
    figure, axes = _side_by_side(groups, found.cells, 3.3)
    handles: dict[str, Line2D | Patch] = {}
    for ax, group in zip(axes, groups, strict=True):
        ax.axvline(0, color="#333333", linewidth=0.9, zorder=1)
        learners = sum(profile.role != "reference" for profile in found.profiles[group])
        for profile in found.profiles[group]:
            color, _, line = style_of(profile.agent)
            if profile.role != "reference" and learners < MANY:
                band: dict[str, Any] = {"color": color, "alpha": 0.13, "linewidth": 0}
                ax.fill_between(THRESHOLDS, profile.low, profile.high, **band)
            ax.plot(THRESHOLDS, profile.share, color=color, linestyle=line, linewidth=1.7)
            if profile.cells < found.cells[group]:
                ax.plot([], [], " ", label=f"{plain(profile.agent)}: {_coverage(profile.cells)}")
            handles.setdefault(
                plain(profile.agent), Line2D([], [], color=color, linestyle=line, linewidth=1.7)
            )
        if ax.get_legend_handles_labels()[1]:
            ax.legend(loc="lower left", fontsize=7.5, frameon=False, handlelength=0)
        ax.set_xlim(_start(found.profiles[group]), THRESHOLDS[-1])
        ax.set_ylim(-0.02, 1.02)
        ax.set_xlabel("share of the gap from the base to certain success")
    axes[0].set_ylabel("share of runs at or above")
    _legend(figure, handles)
    return figure


def _start(profiles: Sequence[Profile]) -> float:
    """Left end of the axis: a little left of 0, or of the largest share that all runs reach."""
    all_in = np.min([profile.share for profile in profiles], axis=0) == 1
    return float(min(THRESHOLDS[all_in].max(initial=THRESHOLDS[0]), 0.0) - 0.03)


def _coverage(cells: int) -> str:
    return f"{cells} cell{'s' if cells > 1 else ''} only"


def improvement_chart(found: Comparisons) -> Figure:
    """P(X > Y) of every pair of learning agents with its 95 % interval; 0.5 is no difference."""
    groups = [group for group, pairs in found.improvements.items() if pairs]
    rows = list(dict.fromkeys((p.first, p.second) for g in groups for p in found.improvements[g]))
    figure, axes = _side_by_side(groups, found.cells, 1.1 + 0.3 * len(rows))
    for ax, group in zip(axes, groups, strict=True):
        ax.axvline(0.5, color="#333333", linewidth=0.9, zorder=1)
        for pair in found.improvements[group]:
            height, p = rows.index((pair.first, pair.second)), pair.probability
            color = style_of(pair.first)[0]
            bar: dict[str, Any] = {"linewidth": 6, "alpha": 0.35, "solid_capstyle": "butt"}
            ax.plot([p.low, p.high], [height] * 2, color=color, **bar)
            ax.plot(p.value, height, "o", color=color, markersize=5, clip_on=False)
            if pair.cells < found.cells[group]:
                beside: dict[str, Any] = {"ha": "left", "va": "bottom", "fontsize": 7.5}
                ax.text(0.0, height - 0.1, _coverage(pair.cells), color="#555555", **beside)
        ax.set_xlim(-0.02, 1.02)
        ax.set_xlabel("P(X > Y)")
    axes[0].set_yticks(range(len(rows)), [f"{plain(x, 24)} > {plain(y, 24)}" for x, y in rows])
    axes[0].set_ylim(len(rows) - 0.5, -0.5)
    return figure


def _side_by_side(
    groups: Sequence[str], cells: Mapping[str, int], height: float
) -> tuple[Figure, list[Axes]]:
    figure = Figure(figsize=(9.0 if len(groups) > 1 else 5.6, height), layout="constrained")
    axes = list(figure.subplots(1, len(groups), squeeze=False, sharey=True).flat)
    for ax, group in zip(axes, groups, strict=True):
        plural = "s" if cells[group] > 1 else ""
        ax.set_title(f"{group} symmetry, {cells[group]} cell{plural}")
    return figure, axes


def _panels(tables: Sequence[Table], ylabel: str) -> tuple[Figure, list[Axes]]:
    columns = min(COLUMNS, len(tables))
    rows = -(-len(tables) // columns)
    width = 9.0 if columns > 1 else 5.6
    figure = Figure(figsize=(width, 0.75 + 2.75 * rows), layout="constrained")
    grid = figure.subplots(rows, columns, squeeze=False, sharey=ylabel.startswith("success"))
    flat = list(grid.flat)
    for ax in flat[len(tables) :]:
        ax.set_visible(False)
    for index, (ax, table) in enumerate(zip(flat, tables, strict=False)):
        key = table.key
        ax.set_title(_title(table, tables))
        ax.set_xlim(-0.02 * key.env_steps, 1.02 * key.env_steps)
        ax.xaxis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]))
        ax.xaxis.set_major_formatter(FuncFormatter(_thousands))
        ax.set_xlabel("environment steps")
        if index % columns == 0:
            ax.set_ylabel(ylabel)
    key = tables[0].key
    figure.suptitle(plain(f"{key.task}, {key.embodiment}"), fontsize=11, fontweight="bold")
    return figure, flat[: len(tables)]


def _title(table: Table, tables: Sequence[Table]) -> str:
    key, keys = table.key, [other.key for other in tables]
    parts = list(key.broken_by) or ["unbroken"]
    if len({other.base + other.group for other in keys}) > 1:
        parts.append(f"{key.base} {key.group}".strip())
    if len({other.mode for other in keys}) > 1:
        parts.append(f"{key.mode} demonstrations")
    parts += beside_variant(key, keys)
    lines = []
    for words in (parts, key.settings.split(", ")):
        # Lines break between the parts, not within them.
        text = ", ".join(word.replace(" ", SPACE) for word in words)
        lines += wrap(text, TITLE_WIDTH, max_lines=3, placeholder="...")
    return "\n".join(plain(line) for line in lines)


def _legend(figure: Figure, handles: Mapping[str, Line2D | Patch], columns: int = 7) -> None:
    """Entries below the panels, in as many columns as fit."""
    if not handles:
        return
    names, room = list(handles), WIDEST * figure.get_figwidth()
    columns = min(columns, len(names))
    while columns > 1 and _legend_width(names, columns) > room:
        columns -= 1
    figure.legend(
        list(handles.values()), names, loc="outside lower center", ncols=columns, frameon=False
    )


def _legend_width(names: Sequence[str], columns: int) -> int:
    """In characters; matplotlib fills column after column, the first ones with one entry more."""
    parts = np.array_split([len(name) for name in names], columns)
    return sum(int(part.max()) + HANDLE for part in parts)


def style_of(agent: str) -> Style:
    """Colour, marker and line style of an agent, the same in every figure."""
    return STYLES.get(agent) or OTHERS[sum(map(ord, agent)) % len(OTHERS)]


def _thousands(value: float, _position: int | None = None) -> str:
    if abs(value) >= 1e6:
        return f"{value / 1e6:g}M"
    return f"{value / 1e3:g}k" if abs(value) >= 1e3 else f"{value:g}"


def plain(text: str, limit: int = 40) -> str:
    """Text for a figure: printable ASCII, no `$` (matplotlib would read it as mathematics)."""
    text = text.replace(SPACE, " ")
    clean = "".join(c if c.isascii() and c.isprintable() and c != "$" else "?" for c in text)
    return clean if len(clean) <= limit else clean[: limit - 3] + "..."
