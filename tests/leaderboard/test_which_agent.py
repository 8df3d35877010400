"""Advice from the map: the crossing is found, measured cells count first, intervals cover."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from symsteer.leaderboard.advantage_by_defect import Point, points_of
from symsteer.leaderboard.defects import Audit, AuditedDefect, Part
from symsteer.leaderboard.rows import Summary, Table
from symsteer.leaderboard.statistics import Interval, Sample
from symsteer.leaderboard.which_agent import (
    Advice,
    AuditedWorld,
    Choice,
    Expected,
    Lines,
    advise,
    choose,
    expect,
)
from tests.leaderboard.conftest import TASKS, crossing
from tests.leaderboard.record_factory import steered, summary_of

Map = tuple[Summary, Audit]


def world(variant: str, defect: float, task: str = "New-v1", part: Part = "tool") -> AuditedWorld:
    interval = Interval(defect, 0.95 * defect, 1.05 * defect)
    return AuditedWorld(task, "floating", variant, "C8", AuditedDefect(interval, part))


def expected_in(where: AuditedWorld, summary: Summary, audit: Audit) -> Expected:
    """The expected advantage of `equivariant` in final success."""
    points = points_of(summary, audit, where.embodiment, "equivariant", "success")
    return expect(where, Lines(points, resamples=500))


def test_the_crossing_is_found_for_a_new_task(map_of_five: Map) -> None:
    def of(advice: Advice, agent: str, measure: str) -> float:
        (one,) = [e for e in advice.expected if (e.agent, e.measure) == (agent, measure)]
        assert one.value is not None
        return one.value

    summary, audit = map_of_five
    near, far = (advise([summary], audit, world("wind:0.3", x)) for x in (0.05, 0.45))
    for choice in near.choices:
        assert choice.agents[0] == "equivariant"
        assert of(near, "equivariant", choice.measure) == pytest.approx(0.25, abs=0.02)
    for choice in far.choices:
        assert choice.agents == ("approximate",)
        assert of(far, "equivariant", choice.measure) == pytest.approx(-0.15, abs=0.02)
        assert of(far, "approximate", choice.measure) == pytest.approx(0.1, abs=0.02)


@pytest.mark.parametrize(
    ("where", "value", "rests_on"),
    [
        # Four cells of each task, without the obstacle.
        (world("wind:0.3", 0.05), 0.25, ("other tasks", "wind", 20, 25, 5)),
        # A dial that nobody has mapped: by the part of its defect, which two dials have.
        (world("friction_patch:1", 0.05), 0.25, ("other tasks", "part tool", 25, 25, 5)),
        (world("none", 0.0), 0.3, ("other tasks", "none", 5, 25, 5)),
        (world("wind:0.50", 0.2, "D-v1"), 0.15, ("this cell", "wind", 1, 5, 1)),
    ],
)
def test_an_expectation_says_what_it_rests_on(
    map_of_five: Map, where: AuditedWorld, value: float, rests_on: tuple[object, ...]
) -> None:
    one = expected_in(where, *map_of_five)
    assert one.value == pytest.approx(value, abs=0.02)
    assert (one.source, one.kind, one.cells, one.policies, one.tasks) == rests_on
    assert one.reasons == ()


def test_a_known_task_has_its_own_level() -> None:
    offsets = crossing(dict(zip(TASKS, (0.0, 0.025, -0.025, 0.0, 0.25), strict=True)))
    one = expected_in(world("wind:0.3", 0.15, "E-v1"), *offsets)
    assert (one.source, one.tasks) == ("this task", 1)
    assert one.value == pytest.approx(0.3 - 0.15 + 0.25, abs=0.02)
    new = expected_in(world("wind:0.3", 0.15), *offsets)
    assert new.value == pytest.approx(0.3 - 0.15 + 0.05, abs=0.02)
    # What tasks differ in is a part of the interval of a new one.
    assert new.interval.high - new.interval.low > 2 * (one.interval.high - one.interval.low)
    assert new.interval.high > 0.4


def test_too_little_decides_nothing(map_of_five: Map) -> None:
    def reason(where: AuditedWorld, summary: Summary, audit: Audit) -> str:
        one = expected_in(where, summary, audit)
        assert one.sign == 0
        return "; ".join(one.reasons)

    near = world("wind:0.3", 0.1)
    for number in (1, 2):
        few = crossing(dict.fromkeys(TASKS[:number], 0.0))
        assert f"other tasks with such cells: {number}, 3 are needed" in reason(near, *few)
    alone = crossing(dict.fromkeys(TASKS, 0.0), policies=1)
    here = world("wind:0.5", 0.2, "A-v1")
    assert reason(here, *alone) == "base policies: 1, 5 are needed"
    # Two tasks with two cells each: one degree of freedom is left.
    summary, audit = few
    ends = {place: d for place, d in audit.items() if place[2] in ("none", "wind:1")}
    one = expected_in(world("wind:0.3", 0.1, "A-v1"), summary, ends)
    assert (one.source, one.cells) == ("this task", 4)
    assert one.reasons == ("too few cells to say how far they lie from their line",)
    summary, audit = map_of_five
    far = reason(world("wind:0.3", 0.9), summary, audit)
    assert "lies beyond those of the map, 0.00 to 0.50" in far
    # The controls alone are no line.
    nothing = reason(world("directional_reward:1", 0.1, part="cost"), summary, audit)
    assert nothing == "no mapped cell is like it: directional_reward or part cost"
    # What one dial of a part does says nothing of another dial.
    no_obstacle = {place: d for place, d in audit.items() if place[2] != "obstacle:1"}
    one_dial = reason(world("friction_patch:1", 0.1), summary, no_obstacle)
    assert "mapped dials of part tool: 1, 2 are needed" in one_dial


def test_an_embodiment_without_cells_is_undecided(map_of_five: Map) -> None:
    summary, audit = map_of_five
    advice = advise([summary], audit, replace(world("wind:0.3", 0.1), embodiment="panda"))
    assert advice.expected == ()
    assert {(choice.agents, choice.reason) for choice in advice.choices} == {
        ((), "no audited cell has paired runs of a learner and standard")
    }


def test_an_uncertain_audit_widens_the_interval(map_of_five: Map) -> None:
    where = world("wind:0.3", 0.2)
    vague = replace(where, defect=AuditedDefect(Interval(0.2, 0.0, 0.4), "tool"))
    sure, unsure = (expected_in(w, *map_of_five).interval for w in (where, vague))
    assert unsure.value == sure.value
    assert unsure.high - unsure.low > 1.2 * (sure.high - sure.low)


def test_studies_are_paired_apart_and_few_policies_do_not_count(map_of_five: Map) -> None:
    summary, audit = map_of_five
    other = summary_of(steered({"wind:0.5": (0.9, 0.1, 0.1)}, policies=1, task="A-v1"))
    where = world("wind:0.5", 0.2, "A-v1")
    assert advise([summary, other], audit, where) == advise([summary], audit, where)


def test_the_choice() -> None:
    def expected(agent: str, low: float, high: float, *reasons: str) -> Expected:
        interval = Interval((low + high) / 2, low, high)
        return Expected(interval.value, interval, reasons=reasons, agent=agent, measure="auc")

    below, above = expected("a", -0.3, -0.1), expected("b", 0.1, 0.2)
    best, open_ = expected("c", 0.2, 0.4), expected("d", -0.1, 0.9)
    poor = expected("e", 0.5, 0.6, "base policies: 1", "tasks: 1")
    unknown = replace(poor, value=None, interval=None, reasons=("no mapped cell is like it: wind",))
    for given, agents in (
        ([below, above, best, open_], ("c", "b")),
        ([below, below], ("standard",)),
        ([below, open_], ()),
        ([poor], ()),
        # An agent of which too little is known does not make the others worse.
        ([below, poor], ()),
        # One of which nothing is known does not keep the others from being worse.
        ([below, unknown], ("standard",)),
    ):
        assert choose("auc", given).agents == agents
    poorer = replace(poor, reasons=("tasks: 1",))
    assert choose("auc", [poor, poorer]).reason == "base policies: 1; tasks: 1"
    assert choose("auc", [unknown]) == Choice("auc", (), "no mapped cell is like it: wind")


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
            defect = AuditedDefect(Interval(measured, measured - 0.02, measured + 0.02), "tool")
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
    table = summary_of(steered({"none": (0.5, 0.6, 0.5)})).tables[0]
    generator = np.random.default_rng(3)
    inside, widths, trials = 0, [], 60
    for _ in range(trials):
        points = drawn_map(generator, table, 6)
        unseen = points[-2]
        lines = Lines([point for point in points if point is not unseen], resamples=300)
        found = expect(AuditedWorld.of(unseen), lines, known=known)
        assert (found.source, found.reasons) == ("this task" if known else "other tasks", ())
        assert found.interval is not None
        value = float(np.mean([sample.value for sample in unseen.pairs.values()]))
        inside += found.interval.low <= value <= found.interval.high
        widths.append(found.interval.high - found.interval.low)
    assert inside >= 0.9 * trials
    assert np.median(widths) < (0.45 if known else 0.9)
