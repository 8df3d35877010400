"""What symmetry gains by kind of break: the mean advantage over the cells of each kind."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby

from symsteer.leaderboard.catalogue import IN_WORDS
from symsteer.leaderboard.defects import Audit, defect_of, dial_of, parts_of
from symsteer.leaderboard.figures import MEASURE_NAMES, by_rows, look_of
from symsteer.leaderboard.keys import SYMMETRIC_EMBODIMENT, Key
from symsteer.leaderboard.known_agents import STANDARD, USING_SYMMETRY
from symsteer.leaderboard.pairs import MEASURES, advantage
from symsteer.leaderboard.plots import Axis, Dot, Figure, cut
from symsteer.leaderboard.rows import MIN_SEEDS, Summary, Table
from symsteer.leaderboard.sections import Section, View
from symsteer.leaderboard.statistics import Interval, stratified_bootstrap
from symsteer.leaderboard.text import (
    SPACE,
    code,
    count,
    difference,
    ends,
    folded,
    interval,
    table_text,
)
from symsteer.variant import UNBROKEN

EXPLAINED = f"""\
Advantage over `{STANDARD}` by what breaks the symmetry, with 95 % intervals. In brackets: the
*defect*, how differently the world answers to turned copies of a decision."""

NUMBERS = f"""\
Means over cells of the difference in the area under the success curve (AUC) and in success (final
window), paired by base policy and episode. The defect is that of an audit, from the smallest to the
largest of these cells. \u25b2 and \u25bc: the interval excludes 0, in cells with {MIN_SEEDS} pairs.
""".strip()


@dataclass(frozen=True)
class Gain:
    """Advantage of an agent over `STANDARD`, mean over the cells of one kind.

    Attributes:
        kind: what these cells have in common, as markdown.
        measure: one of `MEASURES`.
        cells: their number; those with fewer pairs than a verdict needs are left out, unless
            all have fewer.
        pairs: paired runs in all of them.
        enough: whether the cells have the pairs that a verdict needs.
        defects: smallest and largest audited defect of the kind's cells; None if one has none.
    """

    kind: str
    agent: str
    measure: str
    effect: Interval
    cells: int
    pairs: int
    enough: bool
    defects: tuple[float, float] | None


def gains(summary: Summary, audit: Audit) -> list[Gain]:
    """By kind (unbroken worlds first), agent and measure; what has no paired runs is left out."""
    candidates = (
        _gain(kind, tables, agent, measure, audit)
        for kind, tables in kinds(summary).items()
        for agent in USING_SYMMETRY
        for measure in MEASURES
    )
    return [gain for gain in candidates if gain]


def _gain(
    kind: str, tables: Sequence[Table], agent: str, measure: str, audit: Audit
) -> Gain | None:
    cells = [pairs for t in tables if (pairs := advantage(t, agent, STANDARD, measure))]
    enough = [pairs for pairs in cells if len(pairs) >= MIN_SEEDS]
    if not cells:
        return None
    used = enough or cells
    audited = [defect.value for table in tables if (defect := defect_of(table.key, audit))]
    return Gain(
        kind=kind,
        agent=agent,
        measure=measure,
        effect=stratified_bootstrap([list(pairs.values()) for pairs in used]),
        cells=len(used),
        pairs=sum(map(len, used)),
        enough=bool(enough),
        defects=(min(audited), max(audited)) if len(audited) == len(tables) else None,
    )


def kinds(summary: Summary) -> dict[str, list[Table]]:
    """Tables by the kind of break, in words: unbroken, each dial, each dial with an arm.

    Cells with another budget than most of their task, with fewer demonstrations than the most of
    their place, or whose break begins in mid-run are kinds of their own.
    """

    def others(key: Key) -> tuple[bool, bool]:
        return not summary.has_usual_budget(key), summary.has_few_demonstrations(key)

    def order(key: Key) -> tuple[object, ...]:
        arm = key.embodiment != SYMMETRIC_EMBODIMENT
        return others(key), arm, key.variant != UNBROKEN, key.variant

    tables_by_kind: dict[str, list[Table]] = defaultdict(list)
    for table in sorted(summary.tables, key=lambda table: order(table.key)):
        longer, fewer = others(table.key)
        kind = [_break(table.key)]
        kind += [f"{count(table.key.env_steps)} steps"] if longer else []
        kind += ["few demonstrations"] if fewer else []
        tables_by_kind[", ".join(kind)].append(table)
    return dict(tables_by_kind)


def _break(key: Key) -> str:
    """What breaks the symmetry, without strengths."""
    arm = [] if key.embodiment == SYMMETRIC_EMBODIMENT else ["arm"]
    if key.variant == UNBROKEN:
        return "".join(arm) or "unbroken"
    constant = all(spec.is_constant for spec in parts_of(key.variant) or ())
    known = [IN_WORDS.get(dial, code(dial)) for dial in dial_of(key.variant).split("+")]
    return ", ".join([*arm, " and ".join(known), *([] if constant else ["changing"])])


def render(measured: list[Gain], view: View) -> list[str]:
    """What is shown, the picture, what marks mean, and the table."""
    if not measured:
        return []
    rows: dict[str, dict[str, str]] = {}
    for (kind, agent), both in groupby(measured, key=lambda gain: (gain.kind, gain.agent)):
        by_measure = list(both)
        row = rows.setdefault(kind, {"World": kind})
        row[f"{code(agent)}: AUC,<br>success"] = "<br>".join(
            difference(gain.effect) if gain.enough else interval(gain.effect, sign=True)
            for gain in by_measure
        )
    for kind, of_kind in groupby(measured, key=lambda gain: gain.kind):
        every = list(of_kind)
        rows[kind]["Defect"] = ends(every[0].defects).replace(" ", SPACE)
        rows[kind]["Cells"] = str(max(gain.cells for gain in every))
    numbers = folded("The picture's numbers", [NUMBERS, table_text(list(rows.values()))])
    return [EXPLAINED, *view.drawn(kind="answer"), *numbers]


def figure(measured: Sequence[Gain]) -> Figure:
    """Advantage over the standard agent by kind of break, with 95 % intervals; hollow: few runs.

    In brackets stand the smallest and the largest audited defect of a kind's cells.
    """
    agents = list(dict.fromkeys(gain.agent for gain in measured))
    defects = {gain.kind: gain.defects for gain in measured}
    names = list(defects)
    columns: dict[str, list[Dot]] = {name: [] for name in MEASURE_NAMES.values()}
    for gain in measured:
        shift = agents.index(gain.agent) - (len(agents) - 1) / 2
        look = look_of(gain.agent, width=1.2, size=5, hollow=not gain.enough)
        text = f"{gain.cells} cells, {gain.pairs} pairs of runs"
        dot = Dot(gain.agent, gain.effect, names.index(gain.kind) + 0.24 * shift, look, text)
        columns[MEASURE_NAMES[gain.measure]].append(dot)
    # A kind's marks of code are for markdown.
    plain = [cut(name.replace("`", ""), 44) for name in names]
    brackets = [f" ({ends(between)})" if between else "" for between in defects.values()]
    labels = [name + bracket for name, bracket in zip(plain, brackets, strict=True)]
    return replace(
        by_rows(labels, columns, Axis(f"advantage over {STANDARD}"), 0, grid=False),
        legend={agent: look_of(agent) for agent in agents},
        height=0.9 + 0.28 * len(names),
        kind="answer",
        text="Advantage of symmetry over the standard agent, by kind of break",
    )


SECTION = Section(
    "What symmetry gains",
    lambda findings: gains(findings.summary, findings.audit),
    render,
    figures=lambda measured, summary: [figure(measured)] if measured else [],
)
