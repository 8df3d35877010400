"""Figures over environment steps, strengths and directions, of cells, runs and variants."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from textwrap import wrap
from typing import Any

from symsteer.leaderboard.cell_names import beside_variant
from symsteer.leaderboard.curves import (
    Curve,
    direction_curve,
    mean_series,
    series,
    success_curve,
)
from symsteer.leaderboard.defects import AuditedDefect
from symsteer.leaderboard.figures import COLORS, MANY, MARKERS, SHARE, look_of
from symsteer.leaderboard.known_agents import BASE
from symsteer.leaderboard.plots import FEASIBLE, GREY, Axis, Figure, Look, Plot, Trace, cut
from symsteer.leaderboard.rows import MIN_SEEDS, AgentRow, Summary, Table
from symsteer.leaderboard.runs import Run
from symsteer.leaderboard.text import SPACE

COLUMNS = 3
TITLE_WIDTH = 36
"""Characters of a plot's title."""

FRESH = "fresh return"

Q_AXIS = Axis("Q-value (discounted return)")


def figures_of_cells(summary: Summary) -> list[Figure]:
    """Learning curves and Q-values of every task and embodiment that have them."""
    places: dict[tuple[str, str], list[Table]] = {}
    for table in summary.tables:
        if table.runs:
            places.setdefault((table.key.task, table.key.embodiment), []).append(table)
    figures = []
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
