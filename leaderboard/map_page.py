"""The page's section on the map: advantage of symmetry against the audited defect."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from symsteer.leaderboard.advice import LeaveOut
from symsteer.leaderboard.defects import MEASURES, Fit, Panel, audit_commands
from symsteer.leaderboard.findings import Findings
from symsteer.leaderboard.paper import STANDARD
from symsteer.leaderboard.summary import MIN_SEEDS, Summary
from symsteer.leaderboard.tables import cell_name
from symsteer.leaderboard.text import (
    MARKS,
    NOTHING,
    SPACE,
    code,
    difference,
    image,
    number,
    share,
    stacked,
)
from symsteer.tables import markdown

Figures = Mapping[tuple[str, ...], Mapping[str, tuple[str, str]]]
"""By place, (task, embodiment), (embodiment,) or (), then by kind: description and address."""

COLOUR = "The colour says which."
"""What the figure's colours mean; other charts of the map have other ones."""

MAP = f"""\
Each point is a cell: the advantage over `{STANDARD}`, paired by base policy and seed, against the
*audited defect* of a decision. The defect is measured in simulation, over the steps of an action
chunk that are executed between two decisions: how differently the world answers to turned copies of
the same decision. It is the largest of four parts: horizontal motion of the tool and of the object
(each as a share of its own), cost (as a share of a step's usual cost) and observation (as a share
of the tool's motion). {COLOUR} Broken initial states are no part of a decision; they
are in the table below. Bars are 95 % intervals, hollow points have fewer than {MIN_SEEDS} paired
runs.

The *slope* is that of least squares with an intercept for each base policy: it comes from the dials
alone, never from a comparison of policies, tasks or embodiments. Its interval draws base policies
(runs, where a task has one policy) and episodes, and the defects within their intervals; it is
about these cells. With fewer than {MIN_SEEDS} base policies it decides nothing. Lines in the figure
have this slope and go through the mean of their task; the fan has the slopes of the interval. An
advantage *ends* where the line crosses 0; between the numbers in brackets 0 is not excluded (95 %,
Fieller's method), and a dash there means: up to the end of the measured range.
"""


LEFT_OUT = f"""\
Is the map right about a task that it does not know? Each cell was expected from the other tasks
alone (`symsteer advise`) and compared with what was measured there, in cells with {MIN_SEEDS} base
policies: whether the sign of the advantage was right, also of those cells alone whose measured
interval excludes 0; whether the measured advantage lay inside the expected interval; the mean
absolute error.
"""


def map_section(summary: Summary, findings: Findings, figures: Figures) -> list[str]:
    """Paragraphs of the section, without its heading."""
    found = findings.map
    parts = [MAP.strip()]
    for embodiment in found.embodiments:
        agents = found.agents(embodiment)
        panels = [found.panel(embodiment, a, m) for a in agents for m in MEASURES]
        parts.append(f"### {code(embodiment)}")
        if drawn := figures.get((embodiment,)):
            parts += [image(*figure) for figure in drawn.values()]
        parts += [_slopes(panels), _numbers(summary, panels)]
    if tested := [one for one in findings.left_out if one.agents]:
        parts += ["### A task that the map does not know", LEFT_OUT.strip(), _left_out(tested)]
        parts += [text for one in tested if (text := _best_left_out(one))]
    if not found.embodiments:
        parts.append("There is no map yet: no audited cell has paired runs of these agents.")
    if found.unaudited:
        names = {t.key: cell_name(t, summary) for t in summary.tables}
        listed = ", ".join(dict.fromkeys(names[key] for key in found.unaudited))
        text = f"Not audited, so not in the map: {listed}."
        if commands := audit_commands(found.unaudited):
            measured = ", ".join(code(command, 1000) for command in commands)
            text += (
                f" To measure them: {measured}; then "
                "`python -m tools.pages.audit leaderboard/results/audit/summary.json "
                "runs/audit/summary.json`."
            )
        parts.append(text)
    return parts


def _left_out(tested: Sequence[LeaveOut]) -> str:
    rows = [
        [
            code(one.embodiment),
            code(row.agent),
            _measure(row.measure),
            share(row.right, row.cells),
            share(row.clear_right, row.clear),
            share(row.inside, row.with_interval),
            number(row.error),
        ]
        for one in tested
        for row in one.agents
    ]
    header = [
        "Embodiment",
        "Agent",
        "Advantage in",
        "Sign right",
        "Of clear ones",
        "Inside",
        "Error",
    ]
    return markdown(header, rows, left=3)


def _best_left_out(tested: LeaveOut) -> str:
    """How often the expected best agent was the best one, in a sentence."""
    texts = [
        f"by {_measure(best.measure)} in {share(best.right, best.cells)} cells (the agent that is "
        f"best on average elsewhere: {share(best.usual, best.cells)})"
        for best in tested.best
    ]
    if not texts:
        return ""
    return (
        f"{code(tested.embodiment)}, {len(tested.tasks)} tasks: the expected best agent was the "
        f"best {', '.join(texts)}."
    )


def _measure(name: str) -> str:
    return "AUC" if name == "auc" else name


def _name(panel: Panel) -> list[str]:
    return [code(panel.agent), _measure(panel.measure)]


def _slopes(panels: Sequence[Panel]) -> str:
    rows = []
    for panel in panels:
        fits = {code(dial): fit for dial, fit in panel.dials.items()}
        if len(fits) > 1 and panel.fit:
            fits = {"all": panel.fit} | fits
        rows += [[*_name(panel), dial, *_fit(fit)] for dial, fit in fits.items()]
        if not fits:
            rows.append([*_name(panel), *[NOTHING] * 4, panel.reason])
    header = [
        "Agent",
        "Advantage in",
        "Dial",
        "Base policies",
        "Slope per 1 of defect",
        "Advantage ends at a defect of",
        "Undecided because",
    ]
    return markdown(header, rows, left=3)


def _fit(fit: Fit) -> list[str]:
    slope = fit.slope.interval()
    # A mark would be read as a decision.
    text = stacked(slope, sign=True, marks="" if fit.reason else MARKS[slope.sign])
    reason = fit.reason or ("" if slope.sign else "the interval contains 0")
    return [str(fit.policies), text, NOTHING if fit.reason else _crossing(fit), reason]


def _crossing(fit: Fit) -> str:
    """Where the fitted advantage is 0, in words."""
    found = fit.crossing()
    if found.value is None:
        signs = {(1, 1): "none: above 0 everywhere", (-1, -1): "none: below 0 everywhere"}
        return signs.get((found.before, found.after), "undecided")
    low, high = number(found.low), number(found.high)
    return f"{number(found.value)} [{low}, {high}]".replace(" ", SPACE)


def _numbers(summary: Summary, panels: Sequence[Panel]) -> str:
    points = {(p.table.key, index): p for index, panel in enumerate(panels) for p in panel.points}
    cells = {key: point for (key, _), point in points.items()}
    indices = range(len(panels))
    by_agent = {
        panel.agent: [i for i in indices if panels[i].agent == panel.agent] for panel in panels
    }
    rows = []
    for key, cell in sorted(cells.items(), key=lambda item: (item[1].defect.value, item[0])):
        defect, row = cell.defect, []
        for own in by_agent.values():
            found = [point for index in own if (point := points.get((key, index)))]
            texts = [difference(point.advantage) for point in found] or [NOTHING]
            row.append("<br>".join(texts))
        row.append(str(max(len(points[key, i].pairs) for i in indices if (key, i) in points)))
        resets = stacked(defect.resets, digits=3) if defect.resets_differ else "alike"
        size = stacked(defect.interval, digits=3)
        size += f"<br>{defect.part}"
        rows.append([cell_name(cell.table, summary), size, resets, *row])
    header = ["Cell", "Audited defect, of", "Resets"]
    header += [f"{code(agent)}: AUC,<br>success" for agent in by_agent]
    table = markdown([*header, "Runs"], rows, left=1)
    return f"<details>\n<summary>The map's numbers</summary>\n\n{table}\n\n</details>"
