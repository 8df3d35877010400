"""Advice from the map: the crossing is found, left-out tasks are left out, intervals cover."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from symsteer.leaderboard.advice import (
    Advice,
    Choice,
    Expected,
    Lines,
    World,
    advise,
    choose,
    expect,
    leave_tasks_out,
)
from symsteer.leaderboard.defects import Audit, Defect, Part, Point
from symsteer.leaderboard.findings import analyse
from symsteer.leaderboard.map_page import map_section
from symsteer.leaderboard.records import RunRecord
from symsteer.leaderboard.statistics import Interval, Sample
from symsteer.leaderboard.study import read_study
from symsteer.leaderboard.summary import Summary, Table
from tests.leaderboard.test_defects import audit_of, cells, summary_of

DEFECTS = {"none": 0.0, "wind:0.25": 0.1, "wind:0.5": 0.2, "obstacle:1": 0.35, "wind:1": 0.5}
TASKS = ("A-v1", "B-v1", "C-v1", "D-v1", "E-v1")


def world(variant: str, defect: float, task: str = "New-v1", part: Part = "tool") -> World:
    interval = Interval(defect, 0.95 * defect, 1.05 * defect)
    return World(task, "floating", variant, "C8", Defect(interval, part))


def crossing(offsets: Mapping[str, float], policies: int = 5) -> tuple[Summary, Audit]:
    """`equivariant` gains 0.3 less the defect, and a task's offset; `approximate` 0.1."""
    records: list[RunRecord] = []
    audit: dict[tuple[str, str, str, str], Defect] = {}
    for task, offset in offsets.items():
        rates = {v: (0.4, 0.7 - defect + offset, 0.5) for v, defect in DEFECTS.items()}
        records += cells(rates, policies, task=task)
        audit |= audit_of(DEFECTS, width=0.01, task=task)
    return summary_of(records), audit


@pytest.fixture(scope="module")
def map_of_five() -> tuple[Summary, Audit]:
    return crossing(dict(zip(TASKS, (0.0, 0.025, -0.025, 0.05, -0.05), strict=True)))


def of(advice: Advice, agent: str, measure: str = "success") -> Expected:
    (found,) = [e for e in advice.expected if (e.agent, e.measure) == (agent, measure)]
    return found


def chosen(advice: Advice) -> dict[str, tuple[str, ...]]:
    return {choice.measure: choice.agents for choice in advice.choices}


def test_the_crossing_is_found_for_a_new_task(map_of_five: tuple[Summary, Audit]) -> None:
    summary, audit = map_of_five
    near, far = (advise([summary], audit, world("wind:0.3", x)) for x in (0.05, 0.45))
    for measure in ("success", "auc"):
        assert chosen(near)[measure][0] == "equivariant"
        assert chosen(far)[measure] == ("approximate",)
        assert of(near, "equivariant", measure).value == pytest.approx(0.25, abs=0.02)
        assert of(far, "equivariant", measure).value == pytest.approx(-0.15, abs=0.02)
        assert of(far, "approximate", measure).value == pytest.approx(0.1, abs=0.02)
    one = of(near, "equivariant")
    assert (one.source, one.kind, one.reasons) == ("other tasks", "wind", ())
    # Four cells of each task, without the obstacle.
    assert (one.cells, one.policies, one.tasks) == (20, 25, 5)
    # A dial that nobody has mapped: by the part of its defect, which two dials have.
    other = of(advise([summary], audit, world("friction_patch:1", 0.05)), "equivariant")
    assert (other.kind, other.cells, other.reasons) == ("part tool", 25, ())
    assert other.value == pytest.approx(0.25, abs=0.02)


def test_a_cell_that_was_measured_speaks_for_itself(map_of_five: tuple[Summary, Audit]) -> None:
    summary, audit = map_of_five
    one = of(advise([summary], audit, world("wind:0.50", 0.2, "D-v1")), "equivariant")
    assert (one.source, one.cells, one.policies) == ("this cell", 1, 5)
    assert one.value == pytest.approx(0.15)


def test_a_known_task_has_its_own_level() -> None:
    summary, audit = crossing(dict(zip(TASKS, (0.0, 0.025, -0.025, 0.0, 0.25), strict=True)))
    one = of(advise([summary], audit, world("wind:0.3", 0.15, "E-v1")), "equivariant")
    assert (one.source, one.tasks) == ("this task", 1)
    assert one.value == pytest.approx(0.3 - 0.15 + 0.25, abs=0.02)
    new = of(advise([summary], audit, world("wind:0.3", 0.15)), "equivariant")
    assert new.value == pytest.approx(0.3 - 0.15 + 0.05, abs=0.02)
    assert one.interval is not None
    assert new.interval is not None
    # What tasks differ in is a part of the interval of a new one.
    assert new.interval.high - new.interval.low > 2 * (one.interval.high - one.interval.low)
    assert new.interval.high > 0.4


@pytest.mark.long
def test_too_little_decides_nothing(map_of_five: tuple[Summary, Audit]) -> None:
    def undecided(summary: Summary, audit: Audit, where: World) -> str:
        advice = advise([summary], audit, where)
        assert chosen(advice) == {"auc": (), "success": ()}
        assert all(e.sign == 0 for e in advice.expected)
        return advice.choices[0].reason

    one_task = crossing({"A-v1": 0.0})
    assert "other tasks with such cells: 1, 3 are needed" in undecided(
        *one_task, world("wind:0.3", 0.1)
    )
    two = crossing({"A-v1": 0.0, "B-v1": 0.0})
    assert "other tasks with such cells: 2, 3" in undecided(*two, world("wind:0.3", 0.1))
    alone = crossing(dict.fromkeys(TASKS, 0.0), policies=1)
    reason = undecided(*alone, world("wind:0.5", 0.2, "A-v1"))
    assert reason == "base policies: 1, 5 are needed"
    summary, audit = map_of_five
    assert "lies beyond those of the map, 0.00 to 0.50" in undecided(
        summary, audit, world("wind:0.3", 0.9)
    )
    nothing = undecided(summary, audit, world("directional_reward:1", 0.1, part="cost"))
    # The controls alone are no line.
    assert nothing == "no mapped cell is like it: directional_reward or part cost"
    # What one dial of a part does says nothing of another dial.
    no_obstacle = {place: d for place, d in audit.items() if place[2] != "obstacle:1"}
    assert "mapped dials of part tool: 1, 2 are needed" in undecided(
        summary, no_obstacle, world("friction_patch:1", 0.1)
    )
    arm = replace(world("wind:0.3", 0.1), embodiment="panda")
    assert undecided(summary, audit, arm) == (
        "no audited cell has paired runs of a learner and standard"
    )


def test_an_unbroken_world_has_the_level_of_unbroken_cells(
    map_of_five: tuple[Summary, Audit],
) -> None:
    one = of(advise([map_of_five[0]], map_of_five[1], world("none", 0.0)), "equivariant")
    assert (one.kind, one.cells, one.tasks) == ("none", 5, 5)
    assert one.value == pytest.approx(0.3, abs=0.02)


def test_an_uncertain_audit_widens_the_interval(map_of_five: tuple[Summary, Audit]) -> None:
    where = world("wind:0.3", 0.2)
    vague = replace(where, defect=Defect(Interval(0.2, 0.0, 0.4), "tool"))
    sure, unsure = (
        of(advise([map_of_five[0]], map_of_five[1], w), "equivariant").interval
        for w in (where, vague)
    )
    assert sure is not None
    assert unsure is not None
    assert unsure.value == sure.value
    assert unsure.high - unsure.low > 1.2 * (sure.high - sure.low)


def test_few_cells_do_not_say_how_far_they_lie_from_a_line() -> None:
    """Two tasks with two cells each: one degree of freedom is left."""
    summary, audit = crossing({"A-v1": 0.0, "B-v1": 0.0})
    few = {place: d for place, d in audit.items() if place[2] in ("none", "wind:1")}
    one = of(advise([summary], few, world("wind:0.3", 0.1, "A-v1")), "equivariant")
    assert (one.source, one.cells) == ("this task", 4)
    assert one.reasons == ("too few cells to say how far they lie from their line",)
    assert one.sign == 0


def test_studies_are_paired_apart_and_few_policies_do_not_count(
    map_of_five: tuple[Summary, Audit],
) -> None:
    summary, audit = map_of_five
    other = summary_of(cells({"wind:0.5": (0.9, 0.1, 0.1)}, policies=1, task="A-v1"))
    where = world("wind:0.5", 0.2, "A-v1")
    mine, both = (advise(s, audit, where) for s in ([summary], [summary, other]))
    assert of(both, "equivariant") == of(mine, "equivariant")


def expected(agent: str, low: float, high: float, *reasons: str) -> Expected:
    middle = (low + high) / 2
    interval = Interval(middle, low, high)
    return Expected(middle, interval, "other tasks", "wind", 9, 9, 9, reasons, agent, "auc")


def test_the_choice() -> None:
    below, above = expected("a", -0.3, -0.1), expected("b", 0.1, 0.2)
    best, open_ = expected("c", 0.2, 0.4), expected("d", -0.1, 0.9)
    assert choose("auc", [below, above, best, open_]).agents == ("c", "b")
    assert choose("auc", [below, below]).agents == ("standard",)
    assert choose("auc", [below, open_]).agents == ()
    poor = expected("e", 0.5, 0.6, "base policies: 1", "tasks: 1")
    assert choose("auc", [poor]).agents == ()
    assert choose("auc", [poor, replace(poor, reasons=("tasks: 1",))]).reason == (
        "base policies: 1; tasks: 1"
    )
    # An agent of which too little is known does not make the others worse.
    assert choose("auc", [below, poor]).agents == ()
    # One of which nothing is known does not keep the others from being worse.
    unknown = replace(poor, value=None, interval=None, reasons=("no mapped cell is like it: wind",))
    assert choose("auc", [below, unknown]).agents == ("standard",)
    assert choose("auc", [unknown]) == Choice("auc", (), "no mapped cell is like it: wind")


# Left-out tasks


def test_what_is_expected_of_a_task_comes_from_the_others_alone() -> None:
    """Four tasks gain 0.2, one loses 0.2, whatever the defect."""
    records: list[RunRecord] = []
    audit: dict[tuple[str, str, str, str], Defect] = {}
    for task in TASKS:
        own = 0.3 if task == "E-v1" else 0.7
        records += cells(dict.fromkeys(DEFECTS, (0.5, own, 0.5)), task=task)
        audit |= audit_of(DEFECTS, task=task)
    found = leave_tasks_out([summary_of(records)], audit, "floating")
    assert found.tasks == TASKS
    rows = {(row.agent, row.measure): row for row in found.agents}
    row = rows["equivariant", "success"]
    # E's cells are expected at +0.2, those of the others at (3 * 0.2 - 0.2) / 4.
    assert (row.cells, row.right, row.clear, row.clear_right) == (25, 20, 25, 20)
    assert row.error == pytest.approx((0.4 + 4 * 0.1) / 5)
    # Four tasks that agree have no spread, so E lies outside; with E among them all lie inside.
    assert (row.with_interval, row.inside) == (25, 20)
    (best,) = [best for best in found.best if best.measure == "success"]
    assert (best.cells, best.right, best.usual) == (25, 20, 20)


def test_the_expected_best_agent_beats_the_usual_one(map_of_five: tuple[Summary, Audit]) -> None:
    """Below a defect of 0.2 one agent is best, above it the other."""
    found = leave_tasks_out([map_of_five[0]], map_of_five[1], "floating")
    for best in found.best:
        assert best.cells == 25
        # At the crossing itself both are equal.
        assert best.right >= 20
        assert best.usual <= 15
    for row in found.agents:
        assert row.error < 0.06
        assert row.inside >= 0.9 * row.with_interval


def test_one_task_cannot_be_left_out() -> None:
    found = leave_tasks_out(
        [crossing({"A-v1": 0.0})[0]], audit_of(DEFECTS, task="A-v1"), "floating"
    )
    assert (found.tasks, found.agents, found.best) == (("A-v1",), (), ())


# Coverage


def drawn_map(
    generator: np.random.Generator, table: Table, tasks: int, policies: int = 6
) -> list[Point]:
    """Tasks differ by 0.1 in level and 0.2 in slope, policies by 0.1 in level, cells by 0.02."""
    points = []
    for task in range(tasks):
        level, slope = 0.2 + generator.normal(0, 0.1), -0.6 + generator.normal(0, 0.2)
        own = generator.normal(0, 0.1, size=policies)
        for strength, truth in zip((0.0, 0.3, 0.6, 1.0), (0.02, 0.15, 0.3, 0.5), strict=True):
            measured = float(abs(truth + generator.normal(0, 0.01)))
            defect = Defect(Interval(measured, measured - 0.02, measured + 0.02), "tool")
            height = level + slope * truth + generator.normal(0, 0.02)
            names = [f"task {task} policy {policy}" for policy in range(policies)]
            values = height + own + generator.normal(0, 0.03, size=policies)
            pairs = {
                (name, seed): Sample.constant(float(value), name)
                for seed, (name, value) in enumerate(zip(names, values, strict=True))
            }
            text = f"wind:{strength}" if strength else "none"
            key = replace(table.key, task=f"T{task}-v1", breaking=(strength > 0, text))
            points.append(Point(replace(table, key=key), defect, pairs))
    return points


@pytest.mark.long
@pytest.mark.parametrize("known", [True, False])
def test_intervals_cover_what_is_measured(known: bool) -> None:
    """The measured advantage of a cell that the line has not seen, of a known and of a new task."""
    table = summary_of(cells({"none": (0.5, 0.6, 0.5)})).tables[0]
    generator = np.random.default_rng(3)
    inside, widths, trials = 0, [], 120
    for _ in range(trials):
        points = drawn_map(generator, table, 6)
        unseen = points[-2]
        lines = Lines([point for point in points if point is not unseen], resamples=300)
        found = expect(World.of(unseen), lines, known=known)
        assert (found.source, found.reasons) == ("this task" if known else "other tasks", ())
        assert found.interval is not None
        value = float(np.mean([sample.value for sample in unseen.pairs.values()]))
        inside += found.interval.low <= value <= found.interval.high
        widths.append(found.interval.high - found.interval.low)
    assert inside >= 0.9 * trials
    assert np.median(widths) < (0.45 if known else 0.9)


@pytest.mark.long
def test_the_page_says_how_often_the_map_is_right(map_of_five: tuple[Summary, Audit]) -> None:
    summary, audit = map_of_five
    found = analyse(summary, audit, read_study("paper"))
    (tested,) = found.left_out
    assert tested == leave_tasks_out([summary], audit, "floating")
    blocks = map_section(summary, found, {})
    start = blocks.index("### A task that the map does not know")
    rows = [line.split(" | ") for line in blocks[start + 2].splitlines()[2:]]
    assert [row[1:3] for row in rows[:2]] == [["`equivariant`", "AUC"], ["`approximate`", "AUC"]]
    for row, one in zip(rows, tested.agents, strict=True):
        shares = (
            (one.right, one.cells),
            (one.clear_right, one.clear),
            (one.inside, one.with_interval),
        )
        assert row[3:6] == [f"{part}/{whole}" if whole else "\u2013" for part, whole in shares]
    best = tested.best[0]
    assert f"by AUC in {best.right}/{best.cells} cells (the agent" in blocks[start + 3]
    alone, audit = crossing({"A-v1": 0.0})
    blocks = map_section(alone, analyse(alone, audit, read_study("paper")), {})
    assert not any("does not know" in block for block in blocks)
