"""The words in which figures are described, whatever draws them.

A `Figure` has plots, a plot has axes and what stands between them: traces (lines), dots with
intervals, rules. `svg` draws a figure for the markdown page, `site.charts` for a browser. Texts may
come from records: who draws them makes them harmless.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

from symsteer.leaderboard.statistics import Array, Interval

Dash = Any
"""A line style of matplotlib: `-`, `:`, `none`, or (offset, lengths)."""

Numbers = Sequence[float] | Array

GREY = "#555555"


@dataclass(frozen=True)
class Look:
    """How a line or a dot looks, and its entry in the legend.

    Attributes:
        color: as `#RRGGBB`.
        marker: as matplotlib names it; empty for none.
        dash: line style; `none` for markers alone.
        width: of the line or of the interval's bar, in points.
        size: of the marker, in points.
        alpha: opacity; None for 1.
        hollow: whether markers are empty.
        edge: colour of an area's edge; with it the entry of the legend is an area.
    """

    color: str
    marker: str = ""
    dash: Dash = "-"
    width: float = 1.5
    size: float = 6.0
    alpha: float | None = None
    hollow: bool = False
    edge: str = ""


FEASIBLE = Look("#DDE7D0", edge="#7A9A50")
"""Of the range of feasible values."""


@dataclass(frozen=True)
class Trace:
    """A line through points.

    Attributes:
        name: of its entry in the legend.
        low, high: ends of the values' intervals, where they have one.
        band: opacity of the interval's band; 0 for none.
        label: what it is, where several traces have one name: `seed 3`.
        single: whether it is a single run among others.
        cross: size of the cross at its end (the run broke off); 0 for none.
        flat: whether it is one value, drawn as a level.
        detail: whether it is left out where lines cannot be switched off.
        remark: what a reader must know of it.
    """

    name: str
    x: Numbers
    y: Numbers
    look: Look
    low: Numbers = ()
    high: Numbers = ()
    band: float = 0.0
    label: str = ""
    single: bool = False
    cross: float = 0.0
    flat: bool = False
    detail: bool = False
    remark: str = ""


@dataclass(frozen=True)
class Dot:
    """A value with its interval, of both coordinates or of x alone.

    Attributes:
        text: what a reader is told who points at it.
        remark: what stands beside it.
        thick: whether the interval is a broad bar.
    """

    name: str
    x: Interval
    y: Interval | float
    look: Look
    text: str = ""
    remark: str = ""
    thick: bool = False


@dataclass(frozen=True)
class Rule:
    """A straight line from edge to edge."""

    at: float
    is_vertical: bool = False
    dash: Dash = "-"


@dataclass(frozen=True)
class Axis:
    """An axis.

    Attributes:
        ends: its range; by default that of the values.
        labels: names of the places 0, 1, ... from top to bottom, in place of numbers.
        linear_to: where a `symlog` axis begins to be logarithmic.
        in_steps: whether it counts environment steps.
        every: distance of the numbers on it; 0 leaves it to who draws.
        grid: whether lines of the grid lead away from it.
    """

    title: str = ""
    ends: tuple[float, float] | None = None
    labels: Sequence[str] = ()
    scale: Literal["linear", "log", "symlog"] = "linear"
    linear_to: float = 1.0
    in_steps: bool = False
    every: float = 0.0
    grid: bool = True


@dataclass(frozen=True)
class Plot:
    """One pair of axes; what comes later in a list is drawn above what comes earlier.

    Attributes:
        feasible: ends of the range of feasible y, which is shaded.
        is_crowded: whether bands would hide more than they show, unless lines can be switched off.
        note: a sentence in its corner.
        empty: what it says if there is nothing to draw.
    """

    x: Axis
    y: Axis
    traces: Sequence[Trace] = ()
    dots: Sequence[Dot] = ()
    rules: Sequence[Rule] = ()
    title: str = ""
    feasible: tuple[float, float] | None = None
    is_crowded: bool = False
    note: str = ""
    empty: str = ""


@dataclass(frozen=True)
class Figure:
    """Plots in a grid, with one legend.

    Attributes:
        legend: entries by name, in order; empty if lines and dots explain themselves.
        height: in inches.
        columns: plots beside each other.
        same_x, same_y: whether all plots have the same axis.
        legend_columns: at most.
        kind: what it is, and the beginning of its file's name.
        place: what it is about: (task, embodiment), (embodiment,) or () for all results.
        text: what it shows, for those who cannot see it.
    """

    plots: Sequence[Plot]
    legend: Mapping[str, Look] = field(default_factory=dict)
    title: str = ""
    height: float = 3.5
    columns: int = 1
    same_x: bool = False
    same_y: bool = False
    legend_columns: int = 7
    kind: str = ""
    place: tuple[str, ...] = ()
    text: str = ""


def cut(text: str, limit: int = 40) -> str:
    """A name of bounded length on one line."""
    text = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return text if len(text) <= limit else text[: limit - 3] + "..."
