"""Which agent, in which world, at which budget; and what a camera error costs."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Container, Sequence
from dataclasses import dataclass
from statistics import fmean

from symsteer.leaderboard.catalogue import BIAS, BIAS_CENTIMETRES
from symsteer.leaderboard.defects import parts_of
from symsteer.leaderboard.keys import Key
from symsteer.leaderboard.known_agents import BASE, STANDARD
from symsteer.leaderboard.pairs import advantage
from symsteer.leaderboard.rows import MIN_SEEDS, Summary, Table
from symsteer.leaderboard.sections import Section, View
from symsteer.leaderboard.sections.what_symmetry_gains import kinds
from symsteer.leaderboard.statistics import Interval, Sample, stratified_bootstrap
from symsteer.leaderboard.text import NOTHING, SPACE, code, count, interval, number, table_text
from symsteer.variant import UNBROKEN

EXPLAINED = """\
Success at the end of the budget, mean over the cells of each kind of world (tasks and strengths).
**Bold**: the best learner, and every learner that is not shown to be below it (pairs by base policy
and episode, 95 %; of several tasks, also without any one of them)."""

CAMERA = """\
**What a camera error costs**: final success where objects are seen so far from their place, and
below it the change from the unbroken world, on the same base policies, with 95 % intervals."""


@dataclass(frozen=True)
class World:
    """What was measured in the cells of one kind that have the same learners.

    Attributes:
        kind: as markdown.
        tables: those cells.
        success: mean over them, by agent; the frozen policy without an agent is `BASE`.
        best: the best learner, and those that are not clearly below it.
    """

    kind: str
    tables: list[Table]
    success: dict[str, float]
    best: list[str]


@dataclass(frozen=True)
class CameraError:
    """What it costs to see objects displaced.

    Attributes:
        centimetres: by which they are displaced.
        cells: their number.
        success: final success, mean over them, by agent.
        change: of it from the unbroken world.
    """

    centimetres: float
    cells: int
    success: dict[str, float]
    change: dict[str, Interval]


@dataclass(frozen=True)
class InWorlds:
    """Of every kind of world; and of every camera error."""

    worlds: list[World]
    errors: list[CameraError]


def compute(summary: Summary) -> InWorlds:
    """Kinds without a cell in which `STANDARD` and another learner have enough base policies are
    left out."""
    each = kinds(summary).items()
    worlds = (world_of(kind, tables, summary.agents) for kind, tables in each)
    return InWorlds([world for world in worlds if world], camera_errors(summary))


def world_of(kind: str, tables: Sequence[Table], agents: Sequence[str]) -> World | None:
    """The learners that all cells have; if these are too few, those that most of them have."""
    several = [table.decisive for table in tables if {STANDARD} < table.decisive]
    if not several:
        return None
    wanted = frozenset.intersection(*several)
    if len(wanted) == 1:
        wanted = Counter(several).most_common(1)[0][0]
    used = [table for table in tables if wanted <= table.decisive]
    names = [agent for agent in agents if agent in wanted]
    success = {
        agent: fmean(fmean(_of(table, agent).values()) for table in used)
        for agent in (BASE, *names)
        if all(table.row_of(agent) for table in used)
    }
    top = max(success[agent] for agent in names)
    tops = [agent for agent in names if success[agent] == top]
    best = [a for a in names if a in tops or not any(_above(used, one, a) for one in tops)]
    return World(kind, used, success, best)


def _above(tables: Sequence[Table], first: str, second: str) -> bool:
    """Whether an agent's final success is clearly above that of another one.

    Without any one of several tasks, too.
    """
    pairs = [
        (table.key.task, each)
        for table in tables
        if (each := list(advantage(table, first, second, "success").values()))
    ]
    tasks = {task for task, _ in pairs}
    parts = [pairs]
    if len(tasks) > 1:
        parts += [[each for each in pairs if each[0] != task] for task in sorted(tasks)]
    return bool(pairs) and all(
        stratified_bootstrap([each for _, each in part]).sign > 0 for part in parts
    )


def camera_errors(summary: Summary) -> list[CameraError]:
    """By distance, in the places with the most distances and with the agents that all have.

    Where all places have one distance alone, each distance has its own places.
    """
    unbroken = {_place(t.key): t for t in summary.usual_tables if t.key.variant == UNBROKEN}
    places: dict[tuple[str, ...], dict[float, Table]] = defaultdict(dict)
    for table in summary.usual_tables:
        if (distance := _distance(table.key)) and _place(table.key) in unbroken:
            places[_place(table.key)][distance] = table
    most = max(map(len, places.values()), default=0)
    used = {place: tables for place, tables in places.items() if len(tables) == most}
    shared = [*map(set, used.values())]
    distances = set.union(set(), *shared) if most < 2 else set.intersection(*shared)
    known = [a for a, role in summary.roles.items() if a == BASE or role == "learner"]
    # All rows are of the same base policies.
    policies = {
        (place, agent): _shared(
            [unbroken[place], *(tables[each] for each in distances & tables.keys())], agent
        )
        for place, tables in used.items()
        for agent in known
    }
    agents = [a for a in known if all(len(policies[p, a]) >= MIN_SEEDS for p in used)]
    errors = []
    for distance in sorted(distances) if STANDARD in agents else ():
        cells = [(unbroken[p], used[p][distance], p) for p in used if distance in used[p]]
        success, change = {}, {}
        for a in agents:
            success[a] = fmean(fmean(_of(far, a)[q] for q in policies[p, a]) for _, far, p in cells)
            change[a] = stratified_bootstrap(
                [_changes(near, far, a, policies[p, a]) for near, far, p in cells]
            )
        errors.append(CameraError(distance, len(cells), success, change))
    return errors


def _changes(near: Table, far: Table, agent: str, policies: Sequence[str]) -> list[Sample]:
    """Of final success, on each of these base policies."""
    before, after = _of(near, agent), _of(far, agent)
    return [Sample.constant(after[policy] - before[policy], policy) for policy in policies]


def _of(table: Table, agent: str) -> dict[str, float]:
    """Final success of an agent by base policy."""
    row = table.row_of(agent)
    return row.by_policy("success") if row else {}


def _shared(tables: Sequence[Table], agent: str) -> list[str]:
    """The base policies on which an agent has runs in all these cells."""
    return sorted(set.intersection(*(set(_of(table, agent)) for table in tables)))


def _place(key: Key) -> tuple[str, ...]:
    return *key.place, key.settings


def _distance(key: Key) -> float:
    """By how many centimetres objects are seen displaced; 0 where anything else is broken, too."""
    parts = parts_of(key.variant) or ()
    if [part.name for part in parts] != [BIAS] or not isinstance(parts[0].strength, float):
        return 0.0
    return BIAS_CENTIMETRES * parts[0].strength * parts[0].is_constant


def render(found: InWorlds, view: View) -> list[str]:
    """A row for each kind of world, a column for each agent; the same for camera errors."""
    if not found.worlds:
        return []

    def columns(agents: Container[str]) -> list[str]:
        return [agent for agent in view.summary.agents if agent in agents]

    shown = columns({agent for world in found.worlds for agent in world.success})
    rows = [
        {"World": world.kind, "Steps": count(world.tables[0].key.env_steps)}
        | {code(agent): _shown(world, agent) for agent in shown}
        | {"Cells": str(len(world.tables))}
        for world in found.worlds
    ]
    errors = [
        {"Camera error": f"{error.centimetres:g} cm".replace(" ", SPACE)}
        | {
            code(a): f"{number(error.success[a])}<br>{interval(error.change[a], sign=True)}"
            for a in columns(error.change)
        }
        | {"Cells": str(error.cells)}
        for error in found.errors
    ]
    told = [CAMERA, table_text(errors)] if errors else []
    return [EXPLAINED, table_text(rows, sparse=True), *told]


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
