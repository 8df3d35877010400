"""What each figure shows: those of the leaderboard's page, and those that the site alone has.

Each function returns a description (`plots`); `svg` and `site.charts` draw it. The colours are
those of Okabe and Ito, which people with colour blindness can tell apart; agents differ by marker
as well.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from textwrap import wrap
from typing import Any

import numpy as np

from symsteer.leaderboard.advantage_by_defect import Fit, Point
from symsteer.leaderboard.cell_names import beside_variant
from symsteer.leaderboard.curves import (
    Curve,
    direction_curve,
    mean_series,
    series,
    success_curve,
)
from symsteer.leaderboard.defects import AuditedDefect
from symsteer.leaderboard.known_agents import BASE, STANDARD
from symsteer.leaderboard.pairs import MEASURES
from symsteer.leaderboard.plots import (
    FEASIBLE,
    GREY,
    Axis,
    Dash,
    Dot,
    Figure,
    Look,
    Plot,
    Rule,
    Trace,
    cut,
)
from symsteer.leaderboard.rows import MIN_SEEDS, AgentRow, Table
from symsteer.leaderboard.runs import Run
from symsteer.leaderboard.sections import (
    Findings,
    defect_map,
    performance_profiles,
    probability_of_improvement,
    what_symmetry_gains,
)
from symsteer.leaderboard.sections.defect_map import DefectMap
from symsteer.leaderboard.sections.performance_profiles import THRESHOLDS, Profile, groups
from symsteer.leaderboard.sections.probability_of_improvement import Improvement
from symsteer.leaderboard.sections.what_symmetry_gains import Gain
from symsteer.leaderboard.text import MARKS, SPACE, ends, interval

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

PARTS = {"tool": "#0072B2", "object": "#D55E00", "cost": "#CC79A7", "observation": "#009E73"}
"""Colours of the map: which part of a decision the defect is of."""
FIT = "#444444"
WITHIN = "within base policies, 95 %"

MEASURE_NAMES = {"auc": "area under the curve", "success": "final success"}

COLUMNS = 3
TITLE_WIDTH = 36
"""Characters of a plot's title."""

MANY = 8
"""With so many learners a plot has no bands of learners, and no single finished runs."""

SHARE = (-0.02, 1.02)
"""Ends of an axis of shares."""

FRESH = "fresh return"

Q_AXIS = Axis("Q-value (discounted return)")


def look_of(agent: str, **more: Any) -> Look:
    """Colour, marker and line style of an agent, with other parts of the look."""
    color, marker, dash = STYLES.get(agent) or OTHERS[sum(map(ord, agent)) % len(OTHERS)]
    return Look(color, marker, dash, **more)


def overall_figures(findings: Findings) -> list[Figure]:
    """Those over all cells, in the order of the page; figures without data are left out."""
    cells = {group: len(tables) for group, tables in groups(findings.summary).items()}
    gains = findings.of(what_symmetry_gains.SECTION)
    advantages = findings.of(defect_map.SECTION)
    profiles = findings.of(performance_profiles.SECTION)
    improvements = findings.of(probability_of_improvement.SECTION)
    figures = [gained(gains)] if gains else []
    figures += [advantage_map(advantages, embodiment) for embodiment in advantages.embodiments]
    figures += [profile_plots(profiles, cells)] if any(profiles.values()) else []
    return figures + ([improvement(improvements, cells)] if any(improvements.values()) else [])


def render_figures(findings: Findings) -> list[Figure]:
    """All figures in the order of the page; figures without data are left out."""
    figures = overall_figures(findings)
    places: dict[tuple[str, str], list[Table]] = {}
    for table in findings.summary.tables:
        if table.runs:
            places.setdefault((table.key.task, table.key.embodiment), []).append(table)
    for tables in places.values():
        figures.append(learning_curves(tables))
        if any(run.record.has_critic for table in tables for run in table.runs):
            figures.append(q_values(tables))
    return figures


def learning_curves(tables: Sequence[Table]) -> Figure:
    """Success over environment steps: one plot a table, the IQM over seeds with its 95 % band.

    Thin lines are single seeds, drawn while these are few; those of unfinished runs are dotted and
    end in a cross. References that were evaluated once are horizontal lines. Plots with `MANY`
    learners have no bands of these.
    """
    axis = Axis("success_once on held-out episodes", SHARE)
    plots = [
        _over_steps(table, tables, axis, [trace for row in table.rows for trace in _success(row)])
        for table in tables
    ]
    agents = {cut(row.label): row.agent for table in tables for row in table.rows if row.runs}
    return _of_cells("success", "Learning curves", tables, plots, _entries(agents), same_y=True)


def _entries(agents: Mapping[str, str]) -> dict[str, Look]:
    """Entries of a legend, by name."""
    return {name: look_of(agent, size=5) for name, agent in agents.items()}


def _success(row: AgentRow) -> list[Trace]:
    """Single runs of a row, and what they have in common."""
    name, few = cut(row.label), 1 < len(row.finished) < MIN_SEEDS
    shown = [run for run in row.runs if not (run.finished and row.is_reference)]
    traces = [_single_success(name, run, detail=run.finished and not few) for run in shown]
    curve = success_curve(row)
    if len(curve.steps) == 1 and row.is_reference:
        # From where the search ended; a reference without a search starts at 0.
        budget = row.runs[0].record.settings.env_steps
        x = [min(row.search_steps or 0, budget), budget]
        y, low, high = curve.values * 2, curve.low * 2, curve.high * 2
        band, look = 0.10 if row.agent == BASE else 0, look_of(row.agent, width=1.4)
        traces.append(Trace(name, x, y, look, low, high, band, flat=True))
    elif curve.steps:
        traces.append(_with_band(name, curve, look_of(row.agent, width=1.7, size=4)))
    return traces


def _single_success(name: str, run: Run, detail: bool = False) -> Trace:
    values = [evaluation.success_once for evaluation in run.curve.values()]
    thin = Look(look_of(run.agent).color, "", "-" if run.finished else ":", 0.7, alpha=0.35)
    x, label, cross = list(run.curve), _run_name(run), 0 if run.finished else 5
    return Trace(name, x, values, thin, label=label, single=True, cross=cross, detail=detail)


def _with_band(name: str, curve: Curve, look: Look) -> Trace:
    return Trace(name, curve.steps, curve.values, look, curve.low, curve.high, band=0.14)


def _run_name(run: Run) -> str:
    return f"seed {run.seed}" + ("" if run.finished else f", {run.record.status}")


def q_values(tables: Sequence[Table]) -> Figure:
    """Mean Q at the actor's own noise against the feasible band of the task's reward.

    Thin lines are single seeds (with `MANY` learners those whose Q is not finite, only), the thick
    line is their mean; hollow markers are the fresh discounted returns that Q should predict. Runs
    that broke off, or whose Q is not finite, end in a cross. The axis turns logarithmic far outside
    the band.
    """
    plots: list[Plot] = []
    agents: dict[str, str] = {}
    for table in tables:
        rows = [row for row in table.rows if any(run.record.has_critic for run in row.runs)]
        agents |= {cut(row.label): row.agent for row in rows}
        traces = [trace for row in rows for trace in _q(row, is_crowded(table))]
        plots.append(_q_plot(_over_steps(table, tables, Q_AXIS, traces), table.feasible))
    legend = _entries(agents)
    if any(trace.label == FRESH and trace.x for plot in plots for trace in plot.traces):
        legend[FRESH] = Look(GREY, "o", "none", size=5, hollow=True)
    if any(plot.feasible for plot in plots):
        legend["feasible"] = FEASIBLE
    return _of_cells("q", "Q-values and their feasible band", tables, plots, legend)


def is_crowded(table: Table) -> bool:
    """Whether it has so many learners that bands and single runs hide more than they show."""
    return len(table.learners) >= MANY


def _q(row: AgentRow, many: bool) -> list[Trace]:
    """Q of single runs, its mean and that of fresh returns."""
    name, look = cut(row.label), look_of(row.agent, width=1.7, size=4)
    runs = [run for run in row.runs if run.record.has_critic]
    traces = [_single_q(name, run, many and not run.record.nonfinite_q) for run in runs]
    traces.append(Trace(name, *mean_series(runs, "q_mean"), look))
    fresh = replace(look, dash="none", hollow=True)
    return [*traces, Trace(name, *mean_series(runs, "return_mean"), fresh, label=FRESH)]


def _single_q(name: str, run: Run, detail: bool = False) -> Trace:
    lost = bool(run.record.nonfinite_q)
    label = _run_name(run) + (", Q not finite" if lost else "")
    cross = 7 if lost or not run.finished else 0
    thin = Look(look_of(run.agent).color, width=0.8, alpha=0.5)
    x, values = series(run, "q_mean")
    return Trace(name, x, values, thin, label=label, single=True, cross=cross, detail=detail)


def _q_plot(plot: Plot, feasible: tuple[float, float] | None) -> Plot:
    """The plot with the feasible band, and an axis on which both it and the values can be read."""
    plot = replace(plot, feasible=feasible, empty="no Q-values")
    if feasible is None:
        return plot
    # The mean of runs lies between them.
    values = [y for trace in plot.traces if trace.label for y in trace.y]
    low, high = feasible
    span = max(high - low, 1e-6)
    bottom, top = min([high, *values]), max([high, *values])
    if top > high + 4 * span or bottom < low - 4 * span:
        return replace(plot, y=replace(plot.y, scale="symlog", linear_to=span))
    if values and bottom - low > 2 * (top - bottom):
        # The lower bound is so far away that showing it would flatten the curves.
        plot = replace(plot, note=f"feasible down to {low:.4g}")
        margin = 0.18 * (top - bottom)
    else:
        bottom = min(bottom, low)
        margin = 0.06 * (top - bottom)
    return replace(plot, y=replace(plot.y, ends=(bottom - margin, top + margin)))


def run_curves(run: Run) -> Figure:
    """Success of one run, and Q with its feasible band where it has a critic."""
    name, look = cut(run.agent), look_of(run.agent, width=1.7, size=4)
    look = replace(look, marker=look.marker or "o")
    alone: dict[str, Any] = {"look": look, "single": False}
    steps, share = _steps(run.record.settings.env_steps), Axis("success_once", SHARE)
    plots = [Plot(steps, share, [replace(_single_success(name, run), **alone)], title="Success")]
    if run.diagnostic("q_mean"):
        fresh = replace(look, dash="none", hollow=True)
        traces = [replace(_single_q(name, run), **alone)]
        traces.append(Trace(name, *series(run, "return_mean"), fresh, label=FRESH))
        plots.append(_q_plot(Plot(steps, Q_AXIS, traces, title="Q-values"), run.feasible))
    return Figure(plots, columns=2, text="Learning curves")


def equivariance_errors(table: Table) -> Figure:
    """Equivariance errors of actors and critics, and of the decoder, on a logarithmic axis."""
    decoders = [run for run in table.runs if run.record.final]
    grey = Look(GREY, "o", (0, (5, 1.5, 1, 1.5)), 1.7, 4, hollow=True)
    measured = {"base policy's decoder": ("equivariance_decode", decoders, grey)}
    for row in table.rows:
        if row.runs and not row.is_reference:
            for part, dash in (("actor", "-"), ("critic", ":")):
                look = replace(look_of(row.agent, width=1.7, size=4), dash=dash)
                runs = row.finished or row.runs
                measured[f"{cut(row.label)}, {part}"] = f"equivariance_{part}", runs, look
    traces = []
    for name, (diagnostic, runs, look) in measured.items():
        points = zip(*mean_series(runs, diagnostic), strict=True)
        if shown := [(x, y) for x, y in points if y > 0 and math.isfinite(y)]:
            traces.append(Trace(name, [x for x, _ in shown], [y for _, y in shown], look))
    axis = Axis("relative equivariance error", scale="log")
    plot = _over_steps(table, [table], axis, traces)
    return Figure([plot], text="Relative equivariance error")


def success_by_direction(table: Table) -> Figure:
    """Success at the end of the budget by the direction in which an episode has to go."""
    traces = [
        _with_band(cut(row.label), curve, look_of(row.agent, width=1.7, size=4))
        for row in table.rows
        if row.finished and (curve := direction_curve(row))
    ]
    x = Axis("direction (degrees)", (-190, 190), every=45)
    y = Axis("success at the end of the budget", SHARE)
    return Figure([Plot(x, y, traces)], text="Success by direction")


def _steps(budget: int) -> Axis:
    return Axis("environment steps", (-0.02 * budget, 1.02 * budget), in_steps=True)


def _over_steps(table: Table, tables: Sequence[Table], y: Axis, traces: Sequence[Trace]) -> Plot:
    x, title = _steps(table.key.env_steps), _title(table, tables)
    return Plot(x, y, traces, title=title, is_crowded=is_crowded(table))


def _of_cells(
    kind: str,
    text: str,
    tables: Sequence[Table],
    plots: Sequence[Plot],
    legend: Mapping[str, Look],
    same_y: bool = False,
) -> Figure:
    """The plots of the cells of a task and embodiment."""
    place, columns = (tables[0].key.task, tables[0].key.embodiment), min(COLUMNS, len(tables))
    return Figure(
        plots,
        legend,
        title=cut(", ".join(place)),
        height=0.75 + 2.75 * -(-len(plots) // columns),
        columns=columns,
        same_y=same_y,
        kind=kind,
        place=place,
        text=text,
    )


def _title(table: Table, tables: Sequence[Table]) -> str:
    key, keys = table.key, [other.key for other in tables]
    differing = list(key.broken_by) or ["unbroken"]
    if len({other.base + other.group for other in keys}) > 1:
        differing.append(f"{key.base} {key.group}".strip())
    if len({other.mode for other in keys}) > 1:
        differing.append(f"{key.mode} demonstrations")
    differing += beside_variant(key, keys)
    lines = []
    for words in (differing, key.settings.split(", ")):
        # Lines break between the words, not within them.
        text = ", ".join(word.replace(" ", SPACE) for word in words)
        lines += wrap(text, TITLE_WIDTH, max_lines=3, placeholder="...")
    return "\n".join(lines)


def advantage_map(defect_map: DefectMap, embodiment: str) -> Figure:
    """Advantage over the standard agent against the audited defect: agents by measures.

    The colour says which part of a decision the defect is of, the marker the task; bars are 95 %
    intervals, hollow points have few runs. A line per task has the slope within base policies and
    goes through the task's mean; the fan around it has the slopes of the 95 % interval.
    """
    agents = defect_map.agents(embodiment)
    panels = [defect_map.panel(embodiment, a, m) for a in agents for m in MEASURES]
    points = [point for panel in panels for point in panel.points]
    tasks = sorted({point.table.key.task for point in points})
    markers = {task: MARKERS[i % len(MARKERS)] for i, task in enumerate(tasks)}
    right = 1.04 * max(point.defect.interval.high for point in points)
    x = Axis(f"audited defect of a decision, {cut(embodiment, 26)}", (-0.02 * right, right))
    y, zero = Axis(f"advantage over {STANDARD}"), [Rule(0)]
    plots = []
    for panel in panels:
        traces = _fit(panel.fit) if panel.fit else []
        dots = [_point(point, markers) for point in panel.points]
        title = f"{panel.agent}, {MEASURE_NAMES[panel.measure]}"
        plots.append(Plot(x, y, traces, dots, zero, title, empty="no paired runs"))
    legend = {cut(task): Look(GREY, marker, "none") for task, marker in markers.items()}
    parts = {point.defect.part for point in points}
    legend |= {part: Look(c, edge=c) for part, c in PARTS.items() if part in parts}
    if any(panel.fit for panel in panels):
        legend[WITHIN] = Look(FIT)
    return Figure(
        plots,
        legend,
        height=1.4 + 2.75 * len(agents),
        columns=len(MEASURES),
        same_x=True,
        same_y=True,
        legend_columns=4,
        kind="map",
        place=(embodiment,),
        text="Advantage of symmetry against the audited defect",
    )


def _point(point: Point, markers: Mapping[str, str]) -> Dot:
    key, part, gain = point.table.key, point.defect.part, point.advantage
    look = Look(PARTS[part], markers[key.task], width=0.8, alpha=0.85, hollow=not point.counts)
    text = (
        f"{', '.join(key.broken_by) or 'unbroken'}, {key.base} {key.group}; {part}; advantage "
        f"{interval(gain, sign=True)}{MARKS[gain.sign]}; {len(point.pairs)} pairs of runs"
    )
    return Dot(cut(key.task), point.defect.interval, gain, look, text)


def _fit(fit: Fit) -> list[Trace]:
    slope, traces = fit.slope.interval(), []
    for line in fit.lines:
        x, y = line.centre
        grid = np.array([line.span[0], x, line.span[1]])
        middle, *fan = (y + s * (grid - x) for s in (slope.value, slope.low, slope.high))
        low, high = np.minimum(*fan), np.maximum(*fan)
        traces.append(Trace(WITHIN, grid, middle, Look(FIT, width=1.4), low, high, band=0.1))
    return traces


def gained(gains: Sequence[Gain]) -> Figure:
    """Advantage over the standard agent by kind of break, with 95 % intervals; hollow: few runs.

    In brackets stand the smallest and the largest audited defect of a kind's cells.
    """
    agents = list(dict.fromkeys(gain.agent for gain in gains))
    defects = {gain.kind: gain.defects for gain in gains}
    kinds = list(defects)
    columns: dict[str, list[Dot]] = {name: [] for name in MEASURE_NAMES.values()}
    for gain in gains:
        shift = agents.index(gain.agent) - (len(agents) - 1) / 2
        look = look_of(gain.agent, width=1.2, size=5, hollow=not gain.enough)
        text = f"{gain.cells} cells, {gain.pairs} pairs of runs"
        dot = Dot(gain.agent, gain.effect, kinds.index(gain.kind) + 0.24 * shift, look, text)
        columns[MEASURE_NAMES[gain.measure]].append(dot)
    columns = {f"advantage over {STANDARD}: {name}": dots for name, dots in columns.items()}
    # A kind's marks of code are for markdown.
    names = [cut(kind.replace("`", ""), 44) for kind in kinds]
    brackets = [f" ({ends(between)})" if between else "" for between in defects.values()]
    labels = [name + bracket for name, bracket in zip(names, brackets, strict=True)]
    return replace(
        by_rows(labels, columns, Axis(), 0, grid=False),
        legend={agent: look_of(agent) for agent in agents},
        height=0.9 + 0.28 * len(kinds),
        kind="answer",
        text="Advantage of symmetry over the standard agent, by kind of break",
    )


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


def profile_plots(by_group: Mapping[str, Sequence[Profile]], cells: Mapping[str, int]) -> Figure:
    """Share of runs that close at least a share of the gap to certain success, with 95 % bands."""
    title, legend, plots = "share of the gap from the base to certain success", {}, []
    for group, profiles in by_group.items():
        traces = []
        for profile in profiles:
            name, is_reference = cut(profile.agent), profile.role == "reference"
            legend[name] = replace(look_of(profile.agent, width=1.7), marker="")
            some = profile.cells < cells[group]
            remark = f"{_cells(profile.cells)} only" if some else ""
            band = () if is_reference else (profile.low, profile.high, 0.13)
            trace = Trace(name, THRESHOLDS, profile.share, legend[name], *band)
            traces.append(replace(trace, remark=remark))
        if traces:
            x, y = Axis(title, _from_start(profiles)), Axis("share of runs at or above", SHARE)
            plot = Plot(x, y, traces, [], [Rule(0, is_vertical=True)], _group(group, cells))
            plots.append(replace(plot, is_crowded=sum(bool(t.band) for t in traces) >= MANY))
    return Figure(
        plots,
        legend,
        height=3.3,
        columns=len(plots),
        same_y=True,
        kind="profiles",
        text="Performance profiles",
    )


def _from_start(profiles: Sequence[Profile]) -> tuple[float, float]:
    """From a little left of 0, or of the largest share that all runs reach."""
    all_in = np.min([profile.share for profile in profiles], axis=0) == 1
    start = min(THRESHOLDS[all_in].max(initial=THRESHOLDS[0]), 0.0)
    return float(start - 0.03), float(THRESHOLDS[-1])


def _cells(number: int) -> str:
    return f"{number} cell{'s' if number > 1 else ''}"


def _group(group: str, cells: Mapping[str, int]) -> str:
    return f"{group} symmetry, {_cells(cells[group])}"


def improvement(by_group: Mapping[str, Sequence[Improvement]], cells: Mapping[str, int]) -> Figure:
    """P(X > Y) of every pair of learning agents with its 95 % interval; 0.5 is no difference."""
    every = [pair for pairs in by_group.values() for pair in pairs]
    names = list(dict.fromkeys((pair.first, pair.second) for pair in every))
    columns: dict[str, list[Dot]] = {}
    for group, pairs in by_group.items():
        for pair in pairs:
            remark = f"{_cells(pair.cells)} only" if pair.cells < cells[group] else ""
            look = Look(look_of(pair.first).color, "o", size=5)
            place = names.index((pair.first, pair.second))
            dot = Dot("", pair.probability, place, look, remark=remark, thick=True)
            columns.setdefault(_group(group, cells), []).append(dot)
    labels = [f"{cut(first, 24)} > {cut(second, 24)}" for first, second in names]
    return replace(
        by_rows(labels, columns, Axis("P(X > Y)", SHARE), undecided=0.5),
        height=1.1 + 0.3 * len(names),
        kind="improvement",
        text="Probability of improvement",
    )


def standing(rows: Mapping[str, tuple[AgentRow, AgentRow | None]]) -> Figure:
    """Success of an agent in each cell, by its name, beside that of the best reference."""
    dots = []
    for index, (row, reference) in enumerate(rows.values()):
        best = Look(GREY, "D", "none", width=0.8, hollow=True)
        look = replace(look_of(row.agent, width=1.7), dash="none")
        if row.success:
            dots.append(Dot(cut(row.agent), row.success, index, look))
        if reference and reference.success:
            dots.append(Dot("best reference", reference.success, index + 0.2, best))
    labels, axis = [cut(name, 60) for name in rows], Axis("success in the final window", SHARE)
    return replace(by_rows(labels, {"": dots}, axis), text="Success in each cell")


def audited_defects(cells: Sequence[tuple[str, str, str, float, AuditedDefect]]) -> Figure:
    """Defect of a decision over the strength of one variant, with 95 % bands.

    Args:
        cells: task, embodiment, group, strength and defect, by rising strength; strength 0 is the
            unbroken task.
    """
    traces = []
    for index, place in enumerate(sorted({cell[:3] for cell in cells})):
        measured = [(strength, d.interval) for *at, strength, d in cells if tuple(at) == place]
        ends = [
            [d.value for _, d in measured],
            [d.low for _, d in measured],
            [d.high for _, d in measured],
        ]
        color, marker = COLORS[index % len(COLORS)], MARKERS[index % len(MARKERS)]
        look = Look(color, marker, width=1.7, size=4)
        curve = Curve([strength for strength, _ in measured], *ends)
        traces.append(_with_band(cut(", ".join(place)), curve, look))
    x, y = Axis("strength", (-0.04, 1.04)), Axis("audited defect of a decision")
    return Figure([Plot(x, y, traces)], text="Defect of a decision over the strength")
