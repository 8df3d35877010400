"""What the charts of the pages show, as plain data; `static/site.js` draws it with Plotly.

A chart is a dictionary with its `kind`, its axes, and series with numbers, names and colours for a
light and a dark page. The numbers are those of the leaderboard's figures.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from symsteer.leaderboard.comparisons import THRESHOLDS, Comparisons
from symsteer.leaderboard.curves import direction_curve, mean_series, series, success_curve
from symsteer.leaderboard.defects import DefectMap, Panel
from symsteer.leaderboard.figures import MEASURE_NAMES, style_of
from symsteer.leaderboard.paper import BASE, STANDARD
from symsteer.leaderboard.records import RunRecord
from symsteer.leaderboard.statistics import Interval
from symsteer.leaderboard.summary import Row, Run, Table
from symsteer.leaderboard.text import MARKS, count, interval, number

Chart = dict[str, Any]

SYMBOLS = {
    "": None,
    "s": "square",
    "D": "diamond",
    "v": "triangle-down",
    "o": "circle",
    "^": "triangle-up",
    "X": "x",
    "P": "cross",
    "<": "triangle-left",
    "h": "hexagon",
    ">": "triangle-right",
    "*": "star",
    "p": "pentagon",
    "d": "diamond-tall",
}
"""Plotly's names of matplotlib's markers."""

MARKERS = tuple(symbol for symbol in SYMBOLS.values() if symbol)

DASHES: dict[Any, str] = {
    "-": "solid",
    (0, (5, 2)): "dash",
    (0, (3, 1.5)): "dash",
    (0, (1, 1.5)): "dot",
    (0, (5, 1.5, 1, 1.5)): "dashdot",
}
"""Plotly's names of matplotlib's line styles."""

TWINS = ("solid", "dot", "dash", "longdash", "dashdot")
"""Line styles of the rows of one agent with different settings."""

DARK = (0x14, 0x18, 0x1F)
"""Background of dark pages."""

CONTRAST = 4.5
"""Of lines with a dark background."""

LONGEST_NAME = 48

TASKS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#A8860B", "#332288", "#56B4E9", "#882255")
"""Colours of tasks."""


def short(text: str, limit: int = LONGEST_NAME) -> str:
    """A name for a legend: on one line, printable, not too long."""
    clean = " ".join("".join(c if c.isprintable() else " " for c in text).split())
    return clean if len(clean) <= limit else clean[: limit - 1] + "…"


def significant(value: float, digits: int = 4) -> float:
    """A number with few digits: charts show no more, and pages stay small."""
    return float(f"{value:.{digits}g}")


def plain(values: Iterable[float]) -> list[float]:
    return [significant(float(value)) for value in values]


def colors(color: str) -> tuple[str, str]:
    """A colour for light pages, and as bright a one as dark pages need."""
    parts = [int(color[i : i + 2], 16) for i in (1, 3, 5)]
    mixed = parts
    for share in range(0, 101, 4):
        mixed = [round(part + (255 - part) * share / 100) for part in parts]
        if (_luminance(mixed) + 0.05) / (_luminance(DARK) + 0.05) >= CONTRAST:
            break
    return color, "#" + "".join(f"{part:02X}" for part in mixed)


def _luminance(parts: Sequence[int]) -> float:
    """Relative luminance of a colour (WCAG 2)."""
    shares = [part / 255 for part in parts]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in shares]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


NEUTRAL = colors("#555555")


def look(agent: str) -> dict[str, Any]:
    """Colours, line and marker of an agent, as in the leaderboard's figures."""
    color, marker, line = style_of(agent)
    return {"color": colors(color), "dash": DASHES[line], "symbol": SYMBOLS[marker]}


def _looks(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Of each row: that of its agent, and a line style of its own where an agent has several."""
    seen: Counter[str] = Counter()
    twins = Counter(row.agent for row in rows)
    looks = []
    for row in rows:
        style = look(row.agent)
        if twins[row.agent] > 1:
            style["dash"] = TWINS[seen[row.agent] % len(TWINS)]
        seen[row.agent] += 1
        looks.append(style)
    return looks


def _steps_axis(budget: int) -> dict[str, Any]:
    return {"title": "environment steps", "range": [-0.02 * budget, 1.02 * budget], "si": True}


def success_chart(table: Table) -> Chart:
    """Learning curves of a cell: the IQM with its 95 % band, and single runs."""
    found = []
    budget = table.key.env_steps
    rows = [row for row in table.rows if row.runs]
    for row, style in zip(rows, _looks(rows), strict=True):
        curve = success_curve(row)
        one: dict[str, Any] = {"name": short(row.label), **style}
        one |= {"x": curve.steps, "y": plain(curve.values)}
        one |= {"low": plain(curve.low), "high": plain(curve.high)}
        one["runs"] = [
            {
                "name": _run_name(run),
                "x": list(run.curve),
                "y": plain(evaluation.success_once for evaluation in run.curve.values()),
                "open": not run.finished,
            }
            for run in row.runs
            if not (run.finished and row.is_reference)
        ]
        if len(curve.steps) == 1 and row.is_reference:
            # From where the search ended; a reference without a search starts at 0.
            start = min(row.search_steps or 0, budget)
            one |= {key: one[key] * 2 for key in ("y", "low", "high")}
            one |= {"x": [start, budget], "flat": True, "band": row.agent == BASE}
        found.append(one)
    axis = {"title": "success on held-out episodes", "range": [-0.02, 1.03]}
    return {"kind": "curves", "x": _steps_axis(budget), "y": axis, "series": found}


def _run_name(run: Run) -> str:
    return f"seed {run.seed}" + ("" if run.finished else f", {run.record.status}")


def q_chart(table: Table) -> Chart | None:
    """Mean Q of a cell against what is feasible, beside fresh returns; None without critics."""
    found = []
    rows = [row for row in table.rows if any(run.record.has_critic for run in row.runs)]
    for row, style in zip(rows, _looks(rows), strict=True):
        runs = [run for run in row.runs if run.record.has_critic]
        steps, means = mean_series(runs, "q_mean")
        at, returns = mean_series(runs, "return_mean")
        one: dict[str, Any] = {"name": short(row.label), **style, "x": steps, "y": plain(means)}
        one["returns"] = {"x": at, "y": plain(returns)}
        one["runs"] = []
        for run in runs:
            x, y = series(run, "q_mean")
            name = _run_name(run) + (", Q not finite" if run.record.nonfinite_q else "")
            cross = not run.finished or run.record.nonfinite_q
            one["runs"].append({"name": name, "x": x, "y": plain(y), "open": cross})
        found.append(one)
    if not found:
        return None
    axis: dict[str, Any] = {"title": "Q and return (discounted reward)"}
    chart = {"kind": "curves", "x": _steps_axis(table.key.env_steps), "y": axis, "series": found}
    values = [y for one in found for line in (one, *one["runs"], one["returns"]) for y in line["y"]]
    return chart | _feasible(axis, table.feasible, values)


def _feasible(
    axis: dict[str, Any], bounds: tuple[float, float] | None, values: Sequence[float]
) -> dict[str, Any]:
    """The feasible band, and an axis on which both it and the values can be read."""
    if bounds is None:
        return {}
    low, high = bounds
    bottom, top = min([high, *values]), max([high, *values])
    note = ""
    if values and bottom - low > 2 * (top - bottom):
        # The lower bound is so far away that showing it would flatten the curves.
        note = f"Feasible down to {number(low, 0)}."
        margin = 0.18 * (top - bottom)
    else:
        bottom = min(bottom, low)
        margin = 0.06 * (top - bottom)
    axis["range"] = plain((bottom - margin, top + margin))
    band = {"low": significant(low), "high": significant(high), "name": "feasible"}
    return {"band": band, "note": note}


def equivariance_chart(table: Table) -> Chart | None:
    """Equivariance errors of actors and critics, and of the decoder; None where none is known."""
    found = []
    rows = [row for row in table.rows if row.runs and not row.is_reference]
    for row, style in zip(rows, _looks(rows), strict=True):
        runs = row.finished or row.runs
        for part, dash in (("actor", "solid"), ("critic", "dot")):
            steps, means = _positive(*mean_series(runs, f"equivariance_{part}"))
            if means:
                name = f"{short(row.label)}, {part}"
                shape = {"color": style["color"], "symbol": style["symbol"], "dash": dash}
                found.append({"name": name, **shape, "x": steps, "y": plain(means)})
    decoders = [run for run in table.runs if run.record.final]
    steps, means = _positive(*mean_series(decoders, "equivariance_decode"))
    if means:
        shape = {"color": NEUTRAL, "symbol": "circle-open", "dash": "dashdot"}
        found.append({"name": "base policy's decoder", **shape, "x": steps, "y": plain(means)})
    if not found:
        return None
    axis = {"title": "relative equivariance error", "log": True}
    x = _steps_axis(table.key.env_steps)
    return {"kind": "curves", "x": x, "y": axis, "series": found}


def direction_chart(table: Table) -> Chart | None:
    """Success by the direction in which an episode has to go; None where records have none."""
    found = []
    rows = [row for row in table.rows if row.finished]
    for row, style in zip(rows, _looks(rows), strict=True):
        curve = direction_curve(row)
        if curve is not None:
            one: dict[str, Any] = {"name": short(row.label), **style}
            one |= {"x": curve.steps, "y": plain(curve.values)}
            found.append(one | {"low": plain(curve.low), "high": plain(curve.high)})
    if not found:
        return None
    x = {"title": "direction (degrees)", "range": [-190, 190], "every": 45}
    axis = {"title": "success at the end of the budget", "range": [-0.02, 1.03]}
    return {"kind": "curves", "x": x, "y": axis, "series": found}


def _positive(steps: Sequence[float], values: Sequence[float]) -> tuple[list[float], list[float]]:
    """The points that a logarithmic axis can show."""
    pairs = [(x, y) for x, y in zip(steps, values, strict=True) if y > 0 and math.isfinite(y)]
    return [x for x, _ in pairs], [y for _, y in pairs]


def map_chart(panels: Sequence[Panel], names: Mapping[Any, str]) -> Chart:
    """Advantage over the standard agent against the audited defect, a series for each agent.

    Args:
        panels: of one embodiment and measure.
        names: of cells, by key.
    """
    found = []
    for panel in panels:
        one: dict[str, Any] = {"name": short(panel.agent), **look(panel.agent)}
        one["points"] = [
            {
                **_ends("x", point.defect.interval),
                **_ends("y", point.advantage),
                "name": short(names[point.table.key], 90),
                "text": f"defect {interval(point.defect.interval)}, {point.defect.part}; "
                f"advantage {interval(point.advantage, sign=True)}{MARKS[point.advantage.sign]}; "
                f"{len(point.pairs)} pairs of runs",
                "hollow": not point.counts,
            }
            for point in panel.points
        ]
        one["lines"] = []
        if panel.fit:
            slope = panel.fit.slope.interval()
            for line in panel.fit.lines:
                at, height = line.centre
                places = [line.span[0], at, line.span[1]]
                middle, *fan = (
                    [height + rise * (place - at) for place in places]
                    for rise in (slope.value, slope.low, slope.high)
                )
                ends = [sorted(pair) for pair in zip(*fan, strict=True)]
                shape = {"x": plain(places), "y": plain(middle)}
                shape |= {"low": plain(low for low, _ in ends)}
                one["lines"].append(shape | {"high": plain(high for _, high in ends)})
        found.append(one)
    measure = MEASURE_NAMES[panels[0].measure]
    x = {"title": "audited defect of a decision", "from_zero": True}
    y = {"title": f"advantage over {STANDARD}", "zero": True}
    return {"kind": "points", "x": x, "y": y, "series": found, "measure": measure}


def map_charts(found: DefectMap, names: Mapping[Any, str]) -> dict[tuple[str, str], Chart]:
    """`map_chart` by embodiment and measure."""
    charts = {}
    for embodiment in found.embodiments:
        for measure in ("auc", "success"):
            panels = [found.panel(embodiment, a, measure) for a in found.agents(embodiment)]
            if any(panel.points for panel in panels):
                charts[embodiment, measure] = map_chart(panels, names)
    return charts


def _ends(axis: str, found: Interval) -> dict[str, float]:
    value, low, high = plain((found.value, found.low, found.high))
    return {axis: value, f"{axis}low": low, f"{axis}high": high}


def profile_charts(found: Comparisons) -> dict[str, Chart]:
    """Performance profiles by group of cells."""
    charts = {}
    for group, profiles in found.profiles.items():
        lines = [
            {
                "name": short(profile.agent),
                **look(profile.agent),
                "x": plain(THRESHOLDS[::2]),
                "y": plain(profile.share[::2]),
                **(
                    {"low": plain(profile.low[::2]), "high": plain(profile.high[::2])}
                    if profile.role != "reference"
                    else {}
                ),
                "symbol": None,
            }
            for profile in profiles
        ]
        x = {"title": "share of the gap from the base to certain success", "zero": True}
        y = {"title": "share of runs at or above", "range": [-0.02, 1.03]}
        if lines:
            charts[group] = {"kind": "curves", "x": x, "y": y, "series": lines}
    return charts


def standing_chart(rows: Sequence[tuple[str, Row, Row | None]]) -> Chart:
    """Success of an agent in each cell, beside that of the best reference.

    Args:
        rows: name of the cell, the agent's row, the best reference.
    """
    agent = rows[0][1].agent
    shown: list[tuple[str, dict[str, Any], list[Row | None]]] = [
        (short(agent), look(agent), [row for _, row, _ in rows]),
        ("best reference", {"color": NEUTRAL, "symbol": "diamond-open"}, [b for *_, b in rows]),
    ]
    found = []
    for name, style, of in shown:
        points = [
            {"at": index, **_ends("x", row.success), "text": f"{row.label} {interval(row.success)}"}
            for index, row in enumerate(of)
            if row and row.success
        ]
        found.append({"name": name, **style, "points": points})
    names = [short(name, 60) for name, *_ in rows]
    x = {"title": "success in the final window", "range": [-0.02, 1.03]}
    return {"kind": "bars", "x": x, "names": names, "series": found}


def audit_chart(cells: Sequence[tuple[str, str, str, float, Interval]]) -> Chart:
    """Defect of a decision over the strength of one variant.

    Args:
        cells: task, embodiment, group, strength, defect; strength 0 is the unbroken task.
    """
    places = sorted({cell[:3] for cell in cells})
    tasks = sorted({task for task, *_ in places})
    found = []
    for task, embodiment, group in places:
        own = sorted(cell[3:] for cell in cells if cell[:3] == (task, embodiment, group))
        label = short(task if embodiment == "floating" else f"{task}, {embodiment}")
        one: dict[str, Any] = {
            "name": label + ("" if group == "C8" else f", {short(group)}"),
            "color": colors(TASKS[tasks.index(task) % len(TASKS)]),
            "dash": "solid" if embodiment == "floating" else "dash",
            "symbol": MARKERS[tasks.index(task) % len(MARKERS)],
            "x": plain(strength for strength, _ in own),
            "y": plain(100 * defect.value for _, defect in own),
            "low": plain(100 * defect.low for _, defect in own),
            "high": plain(100 * defect.high for _, defect in own),
            "bars": True,
        }
        found.append(one)
    x = {"title": "strength", "range": [-0.04, 1.04]}
    y = {"title": "defect of a decision (%)", "from_zero": True}
    return {"kind": "curves", "x": x, "y": y, "series": found}


def run_charts(record: RunRecord, run: Run, feasible: tuple[float, float] | None) -> list[Chart]:
    """Success, and Q with its feasible band, of one run."""
    style = look(run.agent)
    style["symbol"] = style["symbol"] or "circle"
    evaluations = list(run.curve.values())
    once: dict[str, Any] = {"name": "success at least once", **style, "x": list(run.curve)}
    once["y"] = plain(evaluation.success_once for evaluation in evaluations)
    end: dict[str, Any] = {"name": "success at the end", "color": NEUTRAL, "x": list(run.curve)}
    end |= {"dash": "dot", "symbol": "circle-open"}
    end["y"] = plain(
        sum(e.episodes.success_at_end) / len(e.episodes.success_at_end) for e in evaluations
    )
    x = _steps_axis(record.settings.env_steps)
    axis: dict[str, Any] = {"title": "share of held-out episodes", "range": [-0.02, 1.03]}
    charts: list[Chart] = [{"kind": "curves", "x": x, "y": axis, "series": [once, end]}]
    steps, values = series(run, "q_mean")
    if values:
        at, returns = series(run, "return_mean")
        q: dict[str, Any] = {"name": "mean Q", **style, "x": steps, "y": plain(values)}
        q["returns"] = {"x": at, "y": plain(returns)}
        axis = {"title": "Q and return (discounted reward)"}
        chart = {"kind": "curves", "x": x, "y": axis, "series": [q]}
        charts.append(chart | _feasible(axis, feasible, [*q["y"], *q["returns"]["y"]]))
    return charts


def episodes_chart(run: Run) -> Chart:
    """Which held-out episodes succeed at which evaluation, with their returns and lengths."""
    seeds = sorted({seed for e in run.curve.values() for seed in e.episodes.seed})
    place = {seed: index for index, seed in enumerate(seeds)}
    rows = []
    for step, evaluation in run.curve.items():
        episodes = evaluation.episodes
        cells: list[Any] = [None] * len(seeds)
        columns = (episodes.success_once, episodes.success_at_end, episodes.return_)
        for seed, once, end, ret, length in zip(
            episodes.seed, *columns, episodes.episode_len, strict=True
        ):
            value = None if ret is None else significant(ret)
            cells[place[seed]] = [1 + end if once else 0, value, length]
        rows.append({"name": f"{step:,}".replace(",", "\u202f"), "cells": cells})
    return {"kind": "episodes", "seeds": seeds, "rows": rows}


def numbers(chart: Chart) -> tuple[list[str], list[list[str]]]:
    """Header and rows of a table with what a chart of curves shows, for readers who cannot see it.

    Columns are series, rows are places on the x axis, to three digits.
    """
    is_steps = chart["x"].get("si")

    def place(x: float) -> str:
        return count(round(x, -3) if x > 1000 else x) if is_steps else f"{x:g}"

    columns: list[dict[str, str]] = []
    places: dict[str, float] = {}
    for one in chart["series"]:
        ends = zip(one.get("low", ()), one.get("high", ()), strict=True)
        texts = [f" [{_short(low)}, {_short(high)}]" for low, high in ends] or [""] * len(one["y"])
        column = {}
        for x, y, text in zip(one["x"], one["y"], texts, strict=True):
            places.setdefault(place(x), x)
            column[place(x)] = _short(y) + text
        columns.append(column)
    header = [chart["x"]["title"], *(one["name"] for one in chart["series"])]
    ordered = sorted(places, key=places.__getitem__)
    return header, [[at, *(column.get(at, "") for column in columns)] for at in ordered]


def _short(value: float) -> str:
    return f"{value:.3g}".replace("-", "\u2212")
