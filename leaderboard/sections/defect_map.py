"""The map: the advantage of symmetry against the audited defect, and its slopes."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from symsteer.leaderboard.advantage_by_defect import Fit, Point, fit, points_of
from symsteer.leaderboard.cell_names import cell_name
from symsteer.leaderboard.defects import Audit, defect_of, parts_of
from symsteer.leaderboard.figures import MARKERS, MEASURE_NAMES
from symsteer.leaderboard.keys import Key
from symsteer.leaderboard.known_agents import STANDARD, USING_SYMMETRY
from symsteer.leaderboard.pairs import MEASURES, SHORT_NAMES
from symsteer.leaderboard.plots import GREY, Axis, Dot, Figure, Look, Plot, Rule, Trace, cut
from symsteer.leaderboard.rows import MIN_SEEDS, Summary, Table
from symsteer.leaderboard.sections import Section, View, one_page
from symsteer.leaderboard.text import (
    MARKS,
    NOTHING,
    SPACE,
    code,
    difference,
    folded,
    interval,
    mark_of,
    number,
    stacked,
    table_text,
)
from symsteer.terminal import to_paste
from symsteer.variant import UNBROKEN

EXPLAINED = f"""\
Each point is a cell: the advantage over `{STANDARD}`, paired by base policy and seed, against the
*audited defect* of a decision. The defect is measured in simulation, over the steps of an action
chunk that are executed between two decisions: how differently the world answers to turned copies of
the same decision. It is the largest of four parts: horizontal motion of the tool and of the object
(each as a share of its own), cost (as a share of a step's usual cost) and observation (as a share
of the tool's motion). The colour says which. Broken initial states are no part of a decision; they
are in the table below. Bars are 95 % intervals, hollow points have fewer than {MIN_SEEDS} paired
runs.

The *slope* is that of least squares with an intercept for each base policy: it comes from the dials
alone, never from a comparison of policies, tasks or embodiments. Its interval draws base policies
(runs, where a task has one policy) and episodes, and the defects within their intervals; it is
about these cells. With fewer than {MIN_SEEDS} base policies it decides nothing. Lines in the figure
have this slope and go through the mean of their task; the fan has the slopes of the interval. They
are bent, because the axis of the defect is logarithmic. An advantage *ends* where the line of a
single task crosses 0; between the numbers in brackets 0 is not excluded (95 %, Fieller's method),
and a dash there means: up to the end of the measured range."""


@dataclass(frozen=True)
class Panel:
    """The advantage of one agent in one measure against the defect, in one embodiment.

    Attributes:
        fit: over all dials; None if no base policy was steered at two defects.
        dials: fits to the unbroken control and one dial, by its name.
        tasks: fits to the cells of one task, by its name, if there are several.
    """

    embodiment: str
    agent: str
    measure: str
    points: tuple[Point, ...] = ()
    fit: Fit | None = None
    dials: Mapping[str, Fit] = field(default_factory=dict)
    tasks: Mapping[str, Fit] = field(default_factory=dict)

    @property
    def reason(self) -> str:
        """Why the slope decides nothing, whatever its interval; empty if it may."""
        return self.fit.reason if self.fit else "no base policy was steered at two audited defects"


@dataclass(frozen=True)
class DefectMap:
    """All panels, by (embodiment, agent, measure), and the tables that are not audited.

    Arm and gripper have panels of their own: a defect of 0.3 of the unbroken arm is its
    kinematics, one of 0.3 of the gripper a dial.
    """

    panels: Mapping[tuple[str, str, str], Panel]
    unaudited: tuple[Table, ...]

    @property
    def embodiments(self) -> list[str]:
        """Those that have points."""
        return sorted({e for (e, _, _), panel in self.panels.items() if panel.points})

    def agents(self, embodiment: str) -> list[str]:
        """Those of `USING_SYMMETRY` that have points."""
        agents = {a for (e, a, _), panel in self.panels.items() if e == embodiment and panel.points}
        return [agent for agent in USING_SYMMETRY if agent in agents]

    def panel(self, embodiment: str, agent: str, measure: str) -> Panel:
        """A panel, without points if there are none."""
        empty = Panel(embodiment, agent, measure)
        return self.panels.get((embodiment, agent, measure), empty)


def defect_map(summary: Summary, audit: Audit) -> DefectMap:
    """Advantage of `USING_SYMMETRY` over `STANDARD` in audited tables, with slopes."""
    panels = {}
    for embodiment in sorted({table.key.embodiment for table in summary.tables}):
        for agent in USING_SYMMETRY:
            for measure in MEASURES:
                points = points_of(summary, audit, embodiment, agent, measure)
                dials = sorted({point.dial for point in points} - {UNBROKEN})
                fits = {
                    dial: fit([point for point in points if point.dial in (dial, UNBROKEN)])
                    for dial in dials
                }
                panels[embodiment, agent, measure] = Panel(
                    embodiment,
                    agent,
                    measure,
                    points=tuple(points),
                    fit=fit(points),
                    dials={dial: fitted for dial, fitted in fits.items() if fitted},
                    tasks=_by_task(points),
                )
    unaudited = tuple(table for table in summary.tables if not defect_of(table.key, audit))
    return DefectMap(panels, unaudited)


def _by_task(points: Sequence[Point]) -> dict[str, Fit]:
    tasks = sorted({point.table.key.task for point in points})
    fits = {task: fit([p for p in points if p.table.key.task == task]) for task in tasks}
    return {task: fitted for task, fitted in fits.items() if fitted and len(tasks) > 1}


def render(advantages: DefectMap, view: View) -> list[str]:
    """Figures, slopes and numbers by embodiment, and what is missing."""
    parts = [EXPLAINED]
    for embodiment in advantages.embodiments:
        panels = [
            advantages.panel(embodiment, a, m)
            for a in advantages.agents(embodiment)
            for m in MEASURES
        ]
        numbers = folded("The map's numbers", [_numbers(view.summary, panels)])
        parts += [f"### {code(embodiment)}", *view.drawn(embodiment), _slopes(panels)]
        parts.append("\n\n".join(numbers))
    if not advantages.embodiments:
        parts.append("There is no map yet: no audited cell has paired runs of these agents.")
    if advantages.unaudited:
        names = ", ".join(dict.fromkeys(cell_name(t, view.summary) for t in advantages.unaudited))
        text = f"Not audited, so not in the map: {names}."
        if commands := audit_commands([table.key for table in advantages.unaudited]):
            measured = ", ".join(code(command, 1000) for command in commands)
            text += (
                f" To measure them: {measured}; then "
                "`python -m tools.pages.audit leaderboard/results/audit/summary.json "
                "runs/audit/summary.json`."
            )
        parts.append(text)
    return parts


def _slopes(panels: Sequence[Panel]) -> str:
    rows = []
    for panel in panels:
        fits: dict[str, Fit | None] = {code(dial): fit for dial, fit in panel.dials.items()}
        if len(fits) > 1:
            fits = {"all": panel.fit, **fits}
        fits |= {f"all, {code(task)}": fitted for task, fitted in panel.tasks.items()}
        rows += [_slope(panel, dial, fit) for dial, fit in (fits or {NOTHING: None}).items()]
    return table_text(rows, left=3)


def _slope(panel: Panel, dial: str, fit: Fit | None) -> dict[str, str]:
    slope = fit.slope.interval() if fit else None
    reason = fit.reason if fit else panel.reason
    # Tasks have levels of their own: where the mean of several crosses 0 is true of none of them.
    one_task = fit is not None and len({line.setting.task for line in fit.lines}) == 1
    return {
        "Agent": code(panel.agent),
        "Advantage in": SHORT_NAMES[panel.measure],
        "Dial": dial,
        "Base policies": str(fit.policies) if fit else NOTHING,
        # A mark would be read as a decision.
        "Slope per 1 of defect": stacked(slope, sign=True, marks="" if reason else mark_of(slope)),
        "Advantage ends at a defect of": _crossing(fit)
        if fit and one_task and not reason
        else NOTHING,
        "Undecided because": reason or ("" if mark_of(slope) else "the interval contains 0"),
    }


def _crossing(fit: Fit) -> str:
    """Where the fitted advantage is 0, in words."""
    crossing = fit.crossing()
    if crossing.value is None:
        signs = {(1, 1): "none: above 0 everywhere", (-1, -1): "none: below 0 everywhere"}
        return signs.get((crossing.before, crossing.after), "undecided")
    low, high = number(crossing.low), number(crossing.high)
    return f"{number(crossing.value)} [{low}, {high}]".replace(" ", SPACE)


def _numbers(summary: Summary, panels: Sequence[Panel]) -> str:
    """Defect, resets and advantages of each cell, from the least to the most broken one."""
    agents = list(dict.fromkeys(panel.agent for panel in panels))
    cells: dict[tuple[float, Key], dict[tuple[str, str], Point]] = {}
    for panel in panels:
        for point in panel.points:
            cell = cells.setdefault((point.defect.value, point.table.key), {})
            cell[panel.agent, panel.measure] = point
    rows = []
    for _, points in sorted(cells.items()):
        any_point, *_ = points.values()
        defect = any_point.defect
        row = {
            "Cell": cell_name(any_point.table, summary),
            "Audited defect, of": f"{stacked(defect.interval, digits=3)}<br>{defect.part}",
            "Resets": stacked(defect.resets, digits=3) if defect.resets_differ else "alike",
        }
        for agent in agents:
            measured = [points[agent, m] for m in MEASURES if (agent, m) in points]
            texts = [difference(point.advantage) for point in measured]
            row[f"{code(agent)}: AUC,<br>success"] = "<br>".join(texts) or NOTHING
        row["Runs"] = str(max(len(point.pairs) for point in points.values()))
        rows.append(row)
    return table_text(rows)


def audit_commands(keys: Sequence[Key]) -> list[str]:
    """Commands that measure the defects of tables, one for each task, embodiment and group.

    Names that no task or variant could have are left out: text from a record must not become part
    of a command that a reader copies.
    """
    wanted: dict[tuple[str, str, str], dict[str, None]] = {}
    for key in sorted(keys):
        words = (key.task, key.embodiment, key.variant, key.group)
        constant = all(spec.is_constant for spec in parts_of(key.variant) or ())
        if constant and all(re.fullmatch(r"[A-Za-z0-9][\w.:+-]*", w, re.ASCII) for w in words):
            wanted.setdefault((key.task, key.embodiment, key.group), {})[key.variant] = None
    return [
        to_paste(
            *("symsteer", "audit", "--task", task, "--embodiment", embodiment, "--group", group),
            *("--variant", *variants, "--out", "runs/audit"),
        )
        for (task, embodiment, group), variants in wanted.items()
    ]


PARTS = {"tool": "#0072B2", "object": "#D55E00", "cost": "#CC79A7", "observation": "#009E73"}
"""Colours of the map: which part of a decision the defect is of."""
FIT = "#444444"
WITHIN = "within base policies, 95 %"


def figure(advantages: DefectMap, embodiment: str) -> Figure:
    """Advantage over the standard agent against the audited defect: agents by measures.

    The colour says which part of a decision the defect is of, the marker the task; bars are 95 %
    intervals, hollow points have few runs. A line per task has the slope within base policies and
    goes through the task's mean; the fan around it has the slopes of the 95 % interval.
    """
    agents = advantages.agents(embodiment)
    panels = [advantages.panel(embodiment, a, m) for a in agents for m in MEASURES]
    points = [point for panel in panels for point in panel.points]
    tasks = sorted({point.table.key.task for point in points})
    markers = {task: MARKERS[i % len(MARKERS)] for i, task in enumerate(tasks)}
    right = 1.04 * max(point.defect.interval.high for point in points)
    x = Axis(f"audited defect of a decision, {cut(embodiment, 26)}", (-0.02 * right, right))
    if (smallest := min(point.defect.value for point in points)) > 0:
        # A linear axis would draw small defects, which most worlds have, upon each other.
        x = replace(x, ends=(0.7 * smallest, right), scale="log")
    y, zero = Axis(f"advantage over {STANDARD}"), [Rule(0)]
    plots = []
    for panel in panels:
        traces = _lines(panel.fit) if panel.fit else []
        dots = [_dot(point, markers) for point in panel.points]
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


def _dot(point: Point, markers: Mapping[str, str]) -> Dot:
    key, part, gain = point.table.key, point.defect.part, point.advantage
    look = Look(PARTS[part], markers[key.task], width=0.8, alpha=0.85, hollow=not point.counts)
    text = (
        f"{', '.join(key.broken_by) or 'unbroken'}, {key.base} {key.group}; {part}; advantage "
        f"{interval(gain, sign=True)}{MARKS[gain.sign]}; {len(point.pairs)} pairs of runs"
    )
    return Dot(cut(key.task), point.defect.interval, gain, look, text)


def _lines(fit: Fit) -> list[Trace]:
    slope, traces = fit.slope.interval(), []
    for line in fit.lines:
        x, y = line.centre
        # With places between, because a straight line is bent on a logarithmic axis.
        grid = np.unique([*np.linspace(*line.span, 25), x])
        middle, *fan = (y + s * (grid - x) for s in (slope.value, slope.low, slope.high))
        low, high = np.minimum(*fan), np.maximum(*fan)
        traces.append(Trace(WITHIN, grid, middle, Look(FIT, width=1.4), low, high, band=0.1))
    return traces


TITLE = "The advantage of symmetry against the defect"

SECTION = Section(
    TITLE,
    lambda findings: defect_map(findings.summary, findings.audit),
    render,
    figures=lambda advantages, summary: [
        figure(advantages, embodiment) for embodiment in advantages.embodiments
    ],
    apart=one_page("defects", TITLE, render),
)
