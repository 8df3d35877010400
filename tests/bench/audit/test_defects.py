"""The audit finds no defect in the unbroken task, and finds what variants claim to break."""

import dataclasses
import json

import numpy as np
import pytest

from symsteer.bench.audit.defects import audit, reference_task, visit_all
from symsteer.bench.audit.report import (
    EXACT,
    SIGNIFICANT,
    breaks_observation,
    map_figure,
    summary,
    text,
    to_markdown,
)
from symsteer.bench.audit.result import VERSION, AuditResult, AuditSettings
from symsteer.bench.sim.trees import map_trees
from symsteer.bench.variants import VARIANTS
from tests.bench.shared import STATE_TASKS

QUICK = AuditSettings(task="PickCube-v1", states="expert", count=16, resets=64)


class Place:
    """Audits of one task and embodiment, which share their states."""

    def __init__(self, settings: AuditSettings):
        self.settings = settings
        self.reference = reference_task(settings)
        self.visited = visit_all(self.reference, settings, None)
        self.known: dict[tuple, AuditResult] = {}

    def __call__(self, variant: str = "none", **changes) -> AuditResult:
        key = (variant, *changes.items())
        if key not in self.known:
            settings = dataclasses.replace(self.settings, variant=variant, **changes)
            self.known[key] = audit(settings, self.reference, self.visited)
        return self.known[key]


@pytest.fixture(scope="module")
def place():
    place = Place(QUICK)
    yield place
    place.reference.close()


@pytest.fixture(scope="module")
def pushing():
    place = Place(dataclasses.replace(QUICK, task="PushCube-v1", count=48, resets=256))
    yield place
    place.reference.close()


def broken(result: AuditResult, unbroken: AuditResult) -> set[str]:
    """The components in which a result differs from the unbroken one: intervals do not overlap."""
    found = set()
    for row, other in zip(result.dynamics, unbroken.dynamics, strict=True):
        for measure in ("mm", "degrees"):
            if getattr(row, measure).low > getattr(other, measure).high:
                found.add("dynamics")
    if max(result.reward["cost"].value, result.reward["dense"].value) > EXACT:
        found.add("reward")
    if breaks_observation(result):
        found.add("observation")
    if result.resets_p < SIGNIFICANT and result.resets.low > 0:
        found.add("resets")
    return found


def relative(result: AuditResult, body: str = "tool") -> float:
    return result.defect(body).horizontal.value


def test_unbroken(place):
    result = place()
    for body in ("tool", "object"):
        assert result.defect(body).horizontal.high < 0.02
        assert result.defect(body).floor_mm < 1e-3
    # A held cube goes with the gripper; a pushed one need not (see docs/audit.md).
    assert result.decision.high < 0.02
    assert result.part in ("tool", "object")
    # Something was compared: the copies are not the same numbers, and they move.
    assert result.defect("tool").mm.value > 1e-4
    assert result.defect("tool").displacement_mm > 10
    assert broken(result, result) == set()
    assert result.unreachable == 0
    assert 8 <= result.moving < result.states == 16


def test_action_gain_has_the_size_that_it_must_have(place):
    """With one axis scaled by 0.4, turning d by t moves its end by 0.6 |sin t| |d|.

    Vertical motion does not enter: the arm that lifts sees the same defect as one that pushes.
    """
    turns = np.arange(8) * np.pi / 4
    apart = 0.6 * np.abs(np.sin(turns[1:])).mean()
    directions = np.linspace(0, 2 * np.pi, 100)
    moved = np.hypot(0.4 * np.cos(directions), np.sin(directions)).mean()
    result = place("action_gain:1")
    # Less by what the tool does by itself, its velocity's rest.
    assert relative(result) == pytest.approx(apart / moved, rel=0.1)
    tool = result.defect("tool")
    # Less than half of that in three dimensions, where lifting counts as motion.
    assert tool.mm.value / tool.displacement_mm < 0.5 * relative(result)
    assert tool.vertical.high < 0.01
    assert relative(place(), "object") < relative(result, "object")
    assert broken(result, place()) == {"dynamics"}


def test_a_break_of_the_object_alone_is_the_objects():
    """One step of the tool misses what a decision does to the object."""
    place = Place(dataclasses.replace(QUICK, task="PushCube-v1"))
    windy = place("wind:1")
    assert relative(windy) < 0.01
    assert windy.part == "object"
    assert windy.decision == windy.defect("object").horizontal
    assert windy.decision.value > 0.15
    place.reference.close()


BOTH = "directional_reward:1+perception_bias:1"


def test_cost_is_that_of_a_decision(place):
    """The mean over its steps of max(0, dx) / full step, in each of eight directions."""
    result = place(BOTH)
    env, visited = place.reference, place.visited
    tools, going = [], []
    for state in [
        visited.state,
        *(map_trees(lambda later, k=k: later[:, k], visited.path) for k in range(4)),
    ]:
        env.set_state_dict(state)
        tools.append(env.agent.tcp_pose.p[:, :2].double().numpy().copy())
        going.append(~env.get_info()["success"].numpy())
    moved = np.diff(np.stack(tools), axis=0) / env.body.horizontal_step
    turns = np.arange(8) * np.pi / 4
    along = moved[..., :1] * np.cos(turns) - moved[..., 1:] * np.sin(turns)
    alive = np.logical_and.accumulate(going)[1:, :, None]
    # A step costs 1 and what it costs beside, until success.
    extra = np.clip(along, 0, 1) * alive
    costs = extra.mean(axis=0)
    expected = np.abs(costs[:, 1:] - costs[:, :1]).mean()
    assert result.reward["cost"].value == pytest.approx(expected, rel=0.03)
    assert result.parts["cost"] == result.reward["cost"]
    # A mean over the decision, in which directions differ, not the first step alone.
    first = np.abs(extra[0, :, 1:] - extra[0, :, :1]).mean()
    assert abs(result.reward["cost"].value - first) > 0.05 * first


def test_perception_bias_has_the_size_that_it_must_have(place):
    """Root mean square over C8 of the difference of b and its turned image: b sqrt(2 + 2/7)."""
    result = place(BOTH)
    assert broken(result, place()) == {"observation", "reward"}
    offset = 20 * np.sqrt(16 / 7)
    assert result.worst_field.value.value == pytest.approx(offset, rel=1e-4)
    assert result.worst_field.name == "cube_xy"
    # Relative to what a decision moves the tool by, so comparable with a defect of the tool.
    assert result.part == "observation"
    tool = result.defect("tool")
    horizontal = offset / result.decision.value
    assert 0.2 * tool.displacement_mm < horizontal < tool.displacement_mm
    seen = {f.name for f in result.fields if f.value.value > 1e-2}
    assert seen == {"cube_xy", "tcp_to_cube_xy", "cube_to_goal_xy"}
    page = text(result)
    assert "most in cube_xy, 30 mm" in page
    assert "Broken beyond rounding, beside motion: reward, observation." in page


def test_random_observations_are_compared_as_distributions_about_a_shifted_origin(place):
    result = place("observation_noise:1+frame_offset:1")
    assert result.random_observation
    assert not place().random_observation
    assert broken(result, place()) == {"observation", "resets"}
    seen = {f.name for f in result.fields if f.relative.value > 0.02}
    assert "cube_xy" in seen
    assert not any(name.startswith("tcp_") and "cube" not in name for name in seen)
    # Resets are beside the defect of a decision, not in it.
    assert result.part == "observation"
    assert np.hypot(*result.origin_mm) == pytest.approx(50, abs=0.01)
    assert "origin of the group                  (50, 0) mm" in text(result)


def test_results_repeat_and_survive_a_file(place):
    result = place("action_gain:1")
    again = audit(result.settings, place.reference, place.visited)
    assert dataclasses.replace(again, seconds=0) == dataclasses.replace(result, seconds=0)
    data = json.loads(json.dumps(result.to_json()))
    assert AuditResult.from_json(data).to_json() == data
    row = summary(result)
    assert (row["version"], row["variant"]) == (VERSION, "action_gain:1")
    assert row["part"] in ("tool", "object")
    assert row["decision"] == row[row["part"]]
    assert "action_gain:1" in to_markdown([row])


def test_the_map_shows_what_is_broken_and_where(place):
    result = place("action_gain:1")
    assert sum(square.copies for square in result.map if square.body == "tool") == 8 * result.states
    top = max(square.mm for square in result.map if square.body == "tool" and square.copies > 2)
    assert top > 5
    drawn = np.ma.compressed(map_figure(result).axes[0].collections[0].get_array())
    assert drawn.max() == pytest.approx(top)


@pytest.mark.slow
@pytest.mark.parametrize("task", STATE_TASKS)
def test_unbroken_tasks(task):
    place = Place(dataclasses.replace(QUICK, task=task, count=32, resets=256))
    for group in ("C8", "D4"):
        result = place(group=group)
        assert result.defect("tool").horizontal.value < 0.02
        assert broken(result, result) == set()


MOVES = {
    "frame_offset": "resets",
    "spawn_sector": "resets",
    "perception_bias": "observation",
    "camera_rotation": "observation",
    "frame_rotation": "observation",
    "observation_noise": "observation",
    "directional_reward": "reward",
}
"""The one component that each variant breaks (docs/variants.md), if it is not the dynamics."""


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(VARIANTS))
def test_variants_move_what_they_claim_to_move(name, pushing):
    unbroken = pushing()
    half, full = pushing(f"{name}:0.5"), pushing(f"{name}:1")
    # Every rotation is still a symmetry of a turned observation; reflections are not.
    claimed = set() if name.endswith("_rotation") else {MOVES.get(name, "dynamics")}
    for result in (half, full):
        assert broken(result, unbroken) == claimed
    if not claimed:
        mirrored = pushing(f"{name}:1", group="D4")
        assert broken(mirrored, pushing(group="D4")) == {MOVES.get(name, "dynamics")}
    size = {
        "dynamics": lambda c: max(d.mm.value for d in c.dynamics),
        "reward": lambda c: c.reward["cost"].value,
        "observation": lambda c: c.parts["observation"].value,
        "resets": lambda c: c.resets.value,
    }
    for component in claimed:
        assert size[component](half) < size[component](full)


@pytest.mark.slow
def test_the_arm_breaks_the_dynamics():
    place = Place(dataclasses.replace(QUICK, embodiment="panda", count=32))
    result = place()
    assert result.defect("tool").horizontal.low > 0.05
    assert not breaks_observation(result)
    assert result.unreachable < 0.1
