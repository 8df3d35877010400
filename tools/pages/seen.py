"""Writes the tables of docs/seen.md: base policies that see in several ways, and their steering.

python -m tools.pages.seen            # from leaderboard/results/seen
python -m tools.pages.seen RUNS...    # from other runs, a folder or a record each

Audits of base policies are those of leaderboard/results/seen-audit/summary.json.
"""

from __future__ import annotations

import statistics
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from symsteer.bench.audit.report import EXACT, percent
from symsteer.errors import UserError
from symsteer.leaderboard.known_agents import BASE, STANDARD, STRICT, WITHOUT_SYMMETRY
from symsteer.leaderboard.pairs import advantage
from symsteer.leaderboard.paths import RESULTS
from symsteer.leaderboard.row_numbers import summarize
from symsteer.leaderboard.rows import Table
from symsteer.leaderboard.runs import Pair, Run, load_runs
from symsteer.leaderboard.statistics import Interval, Sample, stratified_bootstrap
from symsteer.leaderboard.text import NOTHING, code, difference, mark_of, number, stacked
from symsteer.tables import markdown
from symsteer.variant import UNBROKEN
from tools.pages.audit import read_summary
from tools.pages.marks import CHECKOUT, write_tables
from tools.pages.minima import spread

PAGE = CHECKOUT / "docs" / "seen.md"
RECORDS = RESULTS / "seen"
AUDITS = RESULTS / "seen-audit" / "summary.json"

WAYS = {"Seen": "a cloud of points", "Height": "heights from above", "Hand": "from the hand"}
"""What a policy sees, by how the names of its tasks begin; else poses."""

TASKS = ("PushCube-v1", "PickCube-v1")
"""How the names of the tasks end."""

TURNED = "camera_rotation:1"
ASIDE = ("perception_bias:1", "actuator_offset:0.5")
"""Worlds in which something is displaced to one side."""

DISPLACED = " and ".join(ASIDE)
"""What the mean over these worlds is called."""

APPROXIMATE = "residual-pathway"
LEARNERS = (STANDARD, STRICT, APPROXIMATE)
"""In every world."""

RIVALS = WITHOUT_SYMMETRY[1:]
"""In the unbroken world alone."""

SHOWN = (BASE, *WITHOUT_SYMMETRY, STRICT, APPROXIMATE)

Cells = dict[str, Mapping[Pair, Sample]]
"""Differences of pairs of runs, by task."""

Ways = dict[str, dict[str, Cells]]
"""The same, by what is seen, then by world."""


def way_of(task: str) -> str:
    """What a policy sees in a task."""
    return next((way for begin, way in WAYS.items() if task.startswith(begin)), "poses")


def render(runs: Sequence[Run], audits: Sequence[Mapping[str, Any]]) -> tuple[str, str]:
    """Two texts in markdown: the answers to the page's questions, and all other tables.

    The others are: base policies, their audits, seconds of a run, success, three differences.

    Args:
        runs: finished ones.
        audits: rows of the summary of an audit.

    Raises:
        UserError: if two tables of runs are of one task and world.
    """
    tables = summarize(runs).tables
    worlds = [t for t in tables if {*LEARNERS} <= {row.agent for row in t.learners}]
    named = Counter((table.key.task, table.key.variant) for table in worlds)
    if twice := [name for name, count in named.items() if count > 1]:
        raise UserError(
            f"there are several kinds of runs of {twice[0][0]} in the world {twice[0][1]}, with "
            "other settings; name the folders of one kind"
        )
    strict = by_way(worlds, STRICT, STANDARD, "success")
    rivals = {
        f"{word}, against {code(name)}": by_way(worlds, STRICT, name, measure)
        for name in RIVALS
        for word, measure in (("area", "auc"), ("success", "success"))
    }
    area = by_way(worlds, STRICT, STANDARD, "auc")
    approximate = by_way(worlds, APPROXIMATE, STRICT, "success")
    parts = (
        ("", base_policies(tables)),
        ("Defects of the base policies of seed 140", audited(audits)),
        ("Seconds of a run of 24,000 steps (median)", seconds(worlds)),
        ("Success in the last fifth of the steps", success(worlds)),
        (f"Success: {STRICT} minus {STANDARD}", differences(strict)),
        (f"Area: {STRICT} minus {STANDARD}", differences(area)),
        (f"Success: {APPROXIMATE} minus {STRICT}", differences(approximate)),
    )
    return answers(strict, rivals, area, approximate), "\n\n".join(
        f"**{head}**\n\n{table}" if head else table for head, table in parts
    )


def answers(strict: Ways, rivals: Mapping[str, Ways], area: Ways, approximate: Ways) -> str:
    """The questions of the plan, over both tasks, with a column for each way to see."""
    versus = f"{code(STRICT)} minus {code(STANDARD)}"
    freed = f"{code(APPROXIMATE)} minus {code(STRICT)}"
    questions = (
        (f"1. {versus}, unbroken: area", area, UNBROKEN, False),
        ("success", strict, UNBROKEN, False),
        *((head, found, UNBROKEN, False) for head, found in rivals.items()),
        ("2. where something is displaced: success", strict, DISPLACED, False),
        ("the same, less unbroken", strict, DISPLACED, True),
        ("3. with a turned camera, less unbroken: success", strict, TURNED, True),
        (f"4. {freed}, unbroken: success", approximate, UNBROKEN, False),
        ("where something is displaced", approximate, DISPLACED, False),
    )
    rows = [
        [question, *(_on_two_lines(_over_both(ws, world, beyond)) for ws in found.values())]
        for question, found, world, beyond in questions
    ]
    return markdown(["question", *strict], rows, left=1)


def base_policies(tables: Sequence[Table]) -> str:
    """Of each task: success in held-out episodes, seconds of a training, size."""
    rows = []
    for table in tables:
        row = table.row_of(BASE)
        if table.key.variant != UNBROKEN or row is None:
            continue
        policies = [run.record.base_policy for run in row.finished]
        seconds = [p.training_seconds for p in policies if p.training_seconds is not None]
        rows.append(
            [
                code(table.key.task),
                way_of(table.key.task),
                str(table.key.demonstrations),
                str(len(policies)),
                spread(list(row.by_policy("success").values())),
                f"{statistics.mean(seconds):.0f}" if seconds else NOTHING,
                f"{policies[0].parameters or 0:,}",
            ]
        )
    heads = ["task", "sees", "demonstrations", "trainings", "success [lowest, highest]"]
    return markdown([*heads, "seconds of a training", "parameters"], rows, left=2)


def audited(rows: Sequence[Mapping[str, Any]]) -> str:
    """Defects of a decision by task: of the object's motion, and of what is observed by world."""
    worlds = (UNBROKEN, ASIDE[0], TURNED)
    cells = {(row["task"], row["variant"]): row for row in rows}
    tasks = sorted({task for task, _ in cells}, key=lambda task: (_rank(way_of(task)), task))
    lines = [
        [
            way_of(task),
            code(task),
            percent(cells[task, UNBROKEN]["object"]),
            *(_beyond_rounding(cells[task, world]["observation"]) for world in worlds),
        ]
        for task in tasks
    ]
    heads = ["object", *(f"observed, {code(world)}" for world in worlds)]
    return markdown(["sees", "task", *heads], lines, left=2)


def seconds(tables: Sequence[Table]) -> str:
    """Of a run of each learner, the median over all worlds, by task; some runs were paused."""
    spent: dict[str, dict[str, list[float]]] = {}
    for table in tables:
        for agent in LEARNERS:
            row = table.row_of(agent)
            runs = row.finished if row else []
            times = [run.record.wall_clock.total for run in runs]
            spent.setdefault(table.key.task, {}).setdefault(agent, []).extend(times)
    lines = [
        [
            way_of(task),
            code(task),
            *(f"{statistics.median(t):.0f}" if t else NOTHING for t in own.values()),
        ]
        for task, own in sorted(spent.items(), key=lambda cell: (_rank(way_of(cell[0])), cell[0]))
    ]
    return markdown(["sees", "task", *map(code, LEARNERS)], lines, left=2)


def success(tables: Sequence[Table]) -> str:
    """Of each agent in each task and world."""
    rows = []
    for table in sorted(tables, key=lambda t: (_rank(way_of(t.key.task)), t.key.task)):
        shares = (_success(table, agent) for agent in SHOWN)
        rows.append(
            [way_of(table.key.task), code(table.key.task), code(table.key.variant), *shares]
        )
    return markdown(["sees", "task", "world", *map(code, SHOWN)], rows, left=3)


def by_way(tables: Sequence[Table], first: str, second: str, measure: str) -> Ways:
    """Differences of two agents, in pairs of runs on one base policy.

    The last world of each way to see is the mean over the two of `ASIDE`.
    """
    found: Ways = {}
    for table in tables:
        cells = found.setdefault(way_of(table.key.task), {}).setdefault(table.key.variant, {})
        cells[table.key.task] = advantage(table, first, second, measure)
    for worlds in found.values():
        if {*ASIDE} <= worlds.keys():
            worlds[DISPLACED] = _combined(worlds[ASIDE[0]], worlds[ASIDE[1]], [0.5, 0.5])
    return {way: found[way] for way in sorted(found, key=_rank)}


def differences(found: Ways) -> str:
    """By what is seen and world: in each task, over both, over both less the unbroken world."""
    rows = [
        [
            way,
            " and ".join(map(code, world.split(" and "))),
            *(difference(_mean(_of_task(cells, name))) for name in TASKS),
            difference(_over_both(worlds, world)),
            difference(_over_both(worlds, world, beyond=True) if world != UNBROKEN else None),
        ]
        for way, worlds in found.items()
        for world, cells in worlds.items()
    ]
    heads = [name.removesuffix("-v1") for name in TASKS]
    return markdown(["sees", "world", *heads, "both", "both, less unbroken"], rows, left=2)


def _beyond_rounding(defect: Sequence[float]) -> str:
    return percent(defect) if max(defect) > EXACT else "0"


def _rank(way: str) -> int:
    return ["poses", *WAYS.values()].index(way)


def _success(table: Table, agent: str) -> str:
    row = table.row_of(agent)
    return number(row.success.value) if row and row.success else NOTHING


def _combined(one: Cells, other: Cells, factors: Sequence[float]) -> Cells:
    """Of two worlds, pair by pair: the sum of both differences, each times its factor."""
    return {
        task: {
            pair: Sample.weighted([sample, other[task][pair]], factors)
            for pair, sample in pairs.items()
            if pair in other.get(task, {})
        }
        for task, pairs in one.items()
    }


def _of_task(cells: Cells, name: str) -> Cells:
    return {task: pairs for task, pairs in cells.items() if task.endswith(name)}


def _over_both(worlds: Mapping[str, Cells], world: str, beyond: bool = False) -> Interval | None:
    """The mean over both tasks; if ``beyond``, less that of the unbroken world."""
    cells = worlds.get(world, {})
    if not all(_of_task(cells, name) for name in TASKS):
        return None
    unbroken = worlds.get(UNBROKEN, {})
    return _mean(_combined(cells, unbroken, [1, -1]) if beyond else cells)


def _on_two_lines(mean: Interval | None) -> str:
    return stacked(mean, sign=True, marks=mark_of(mean))


def _mean(cells: Cells) -> Interval | None:
    """Over pairs and tasks, with its interval over base policies and episodes."""
    known = [list(pairs.values()) for pairs in cells.values() if pairs]
    return stratified_bootstrap(known) if known else None


def main(arguments: Sequence[str]) -> int:
    """Write the tables."""
    places = [Path(argument) for argument in arguments] or [RECORDS]
    return write_tables(
        PAGE, lambda: render(load_runs(places, area_from="first update"), read_summary(AUDITS))
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
