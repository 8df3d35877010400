"""Figures as plain data: `static/site.js` draws them with Plotly."""

from __future__ import annotations

from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np

from symsteer.leaderboard.plots import Dot, Figure, Trace
from symsteer.leaderboard.runs import Run
from symsteer.leaderboard.text import MINUS, count

Chart = dict[str, Any]
"""A `Plot` with its part of the figure's legend; what is empty is left out."""


def charts(figure: Figure) -> list[Chart]:
    """The plots of a figure that show something."""
    plots = [replace(plot, traces=[t for t in plot.traces if len(t.x)]) for plot in figure.plots]
    marks: list[list[Trace | Dot]] = [[*plot.traces, *plot.dots] for plot in plots]
    every = [mark for of_plot in marks for mark in of_plot]
    legend = figure.legend or {m.name: m.look for m in every if not getattr(m, "label", "")}
    drawn = {mark.name for mark in every}
    shown = []
    for plot, of_plot in zip(plots, marks, strict=True):
        names = {mark.name for mark in of_plot}
        # Entries that no line or dot has explain colours and markers.
        entries = [
            {"name": name, "look": _plain(look), "drawn": name in names}
            for name, look in legend.items()
            if name in names or name not in drawn
        ]
        if of_plot:
            title = {"title": plot.title if len(plots) > 1 else figure.text, "text": figure.text}
            shown.append(_plain(plot) | title | {"legend": entries})
    return shown


def _plain(value: Any) -> Any:
    """Dictionaries, lists, texts and short numbers: charts show no more, and pages stay small."""
    if is_dataclass(value):
        named = ((field.name, _plain(getattr(value, field.name))) for field in fields(value))
        return {name: one for name, one in named if one or isinstance(one, float | int)}
    if isinstance(value, float):
        return float(f"{value:.4g}")
    return [_plain(one) for one in value] if isinstance(value, list | tuple | np.ndarray) else value


def numbers(chart: Chart) -> tuple[list[str], list[list[str]]]:
    """Header and rows of a table with what the lines of a chart show, for those who see it not.

    Columns are lines over all runs, rows are places on the x axis, to three digits.
    """
    lines = [trace for trace in chart["traces"] if "label" not in trace]
    columns: list[dict[str, str]] = []
    places: dict[str, float] = {}
    for line in lines:
        column = {}
        for index, (x, y) in enumerate(zip(line["x"], line["y"], strict=True)):
            place = (
                count(round(x, -3) if x > 1000 else x) if chart["x"].get("in_steps") else f"{x:g}"
            )
            places.setdefault(place, x)
            ends = [f"{line[end][index]:.3g}" for end in ("low", "high") if end in line]
            text = f"{y:.3g}" + (f" [{', '.join(ends)}]" if ends else "")
            column[place] = text.replace("-", MINUS)
        columns.append(column)
    header = [chart["x"]["title"], *(line["name"] for line in lines)]
    ordered = sorted(places, key=places.__getitem__)
    return header, [[at, *(column.get(at, "") for column in columns)] for at in ordered]


def episodes(run: Run) -> Chart:
    """Which held-out episodes succeed at which evaluation, with their returns and lengths."""
    seeds = sorted({seed for e in run.curve.values() for seed in e.episodes.seed})
    rows = []
    for step, evaluation in run.curve.items():
        columns = evaluation.episodes
        outcomes = zip(columns.success_once, columns.success_at_end, strict=True)
        levels = [1 + end if once else 0 for once, end in outcomes]
        results = (columns.seed, levels, _plain(columns.return_), columns.episode_len)
        by_seed = {seed: result for seed, *result in zip(*results, strict=True)}
        rows.append({"name": grouped(step), "cells": [by_seed.get(seed) for seed in seeds]})
    title = "Every held-out episode of every evaluation"
    return {"seeds": seeds, "rows": rows, "title": title, "text": title}


def grouped(value: int) -> str:
    """A count with its thousands apart."""
    return f"{value:,}".replace(",", "\u202f")
