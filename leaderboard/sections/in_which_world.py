"""Which agent, in which world, at which budget; and what a centimetre of camera error costs."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean

from symsteer.leaderboard.catalogue import BIAS, BIAS_CENTIMETRES, IN_WORDS
from symsteer.leaderboard.defects import parts_of
from symsteer.leaderboard.keys import Key
from symsteer.leaderboard.known_agents import BASE, STANDARD
from symsteer.leaderboard.pairs import advantage
from symsteer.leaderboard.rows import MIN_SEEDS, Summary, Table
from symsteer.leaderboard.sections import Section, View
from symsteer.leaderboard.sections.what_symmetry_gains import kinds
from symsteer.leaderboard.statistics import Interval, Sample, stratified_bootstrap
from symsteer.leaderboard.text import NOTHING, code, count, interval, number, table_text
from symsteer.variant import UNBROKEN

EXPLAINED = """\
Success at the end of the budget, mean over tasks and strengths. **Bold**: the best learner of the
world, and every learner that is not clearly below it (paired by base policy and episode, 95 %).
"""


@dataclass(frozen=True)
class World:
    """What was measured in the cells of one kind that have the same learners.

    Attributes:
        kind: as markdown.
        steps: the budget.
        tables: those cells.
        success: mean over them, by agent; the frozen policy without an agent is `BASE`.
        best: the best learner, and those that are not clearly below it.
    """

    kind: str
    steps: int
    tables: list[Table]
    success: dict[str, float]
    best: list[str]


@dataclass(frozen=True)
class InWorlds:
    """Of every kind of world; what a centimetre costs, by agent."""

    worlds: list[World]
    centimetre: dict[str, Interval]


def compute(summary: Summary) -> InWorlds:
    """Kinds without a cell in which two learners have enough base policies are left out."""
    worlds = (world_of(kind, tables) for kind, tables in kinds(summary, IN_WORDS).items())
    return InWorlds([world for world in worlds if world], centimetre(summary))


def world_of(kind: str, tables: Sequence[Table]) -> World | None:
    """The learners that all cells have; if these are too few, those that most of them have."""
    learners = {
        id(table): {row.agent for row in table.learners if len(row.finished) >= MIN_SEEDS}
        for table in tables
    }
    several = [frozenset(names) for names in learners.values() if {STANDARD} < names]
    if not several:
        return None
    wanted = frozenset.intersection(*several)
    if len(wanted) == 1:
        wanted = Counter(several).most_common(1)[0][0]
    used = [table for table in tables if wanted <= learners[id(table)]]
    success = {
        agent: fmean(fmean(run.success for run in row.finished) for row in rows if row)
        for agent in (BASE, *wanted)
        if all(rows := [table.row_of(agent) for table in used])
    }
    top = max(wanted, key=lambda agent: success[agent])
    return World(
        kind=kind,
        steps=used[0].key.env_steps,
        tables=used,
        success=success,
        best=[agent for agent in wanted if agent == top or not _above(used, top, agent)],
    )


def _above(tables: Sequence[Table], first: str, second: str) -> bool:
    """Whether an agent's final success is clearly above that of another one."""
    pairs = [list(advantage(table, first, second, "success").values()) for table in tables]
    return any(pairs) and stratified_bootstrap([each for each in pairs if each]).sign > 0


def centimetre(summary: Summary) -> dict[str, Interval]:
    """What final success changes by for each centimetre by which objects are seen too far to a
    side, by agent: from the unbroken world to each such world of the same place and budget."""
    unbroken = {_place(t.key): t for t in summary.tables if t.key.variant == UNBROKEN}
    slopes: dict[str, list[list[Sample]]] = defaultdict(list)
    for table in summary.usual_tables:
        distance, other = _distance(table.key), unbroken.get(_place(table.key))
        if not distance or not other:
            continue
        for agent in summary.agents:
            before, after = _by_policy(other, agent), _by_policy(table, agent)
            both = sorted(before.keys() & after.keys())
            if len(both) >= MIN_SEEDS:
                slopes[agent].append(
                    [Sample.constant((after[p] - before[p]) / distance, p) for p in both]
                )
    # The cells that most agents have, so that all are measured in the same worlds.
    most = max(map(len, slopes.values()), default=0)
    return {
        agent: stratified_bootstrap(cells) for agent, cells in slopes.items() if len(cells) == most
    }


def _by_policy(table: Table, agent: str) -> dict[str, float]:
    """Final success on each base policy."""
    row = table.row_of(agent)
    return {run.policy: run.success for run in row.finished} if row else {}


def _place(key: Key) -> tuple[object, ...]:
    return key.place, key.env_steps, key.demonstrations


def _distance(key: Key) -> float:
    """By how many centimetres objects are seen too far to a side; 0 where nothing else holds."""
    parts = parts_of(key.variant) or ()
    if [part.name for part in parts] != [BIAS] or not isinstance(parts[0].strength, float):
        return 0.0
    return BIAS_CENTIMETRES * parts[0].strength * parts[0].is_constant


def render(found: InWorlds, view: View) -> list[str]:
    """A row for each kind of world, a column for each agent."""
    if not found.worlds:
        return []
    agents = [a for a in view.summary.agents if any(a in w.success for w in found.worlds)]
    rows = [
        {"World": world.kind, "Steps": count(world.steps)}
        | {code(agent): _shown(world, agent) for agent in agents}
        | {"Cells": str(len(world.tables))}
        for world in found.worlds
    ]
    costs = [
        f"{code(agent)} {interval(cost, sign=True)}" for agent, cost in found.centimetre.items()
    ]
    said = (
        "**A centimetre of camera error** (objects are seen too far to a side) changes final "
        f"success by: {'; '.join(costs)}."
    )
    return [EXPLAINED.strip(), table_text(rows, sparse=True), *([said] if costs else [])]


def _shown(world: World, agent: str) -> str:
    if agent not in world.success:
        return NOTHING
    text = number(world.success[agent])
    return f"**{text}**" if agent in world.best else text


SECTION = Section(
    "Which agent, in which world",
    lambda findings: compute(findings.summary),
    render,
    where="first",
)
