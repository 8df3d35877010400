"""The audit finds no defect in the unbroken task, and finds what variants claim to break."""

import dataclasses
import json

import numpy as np
import pytest

from symsteer.bench.audit.defects import audit, reference_task, visit_all
from symsteer.bench.audit.measure import Experiment
from symsteer.bench.audit.report import (
    EXACT,
    SIGNIFICANT,
    map_figure,
    summary,
    text,
    to_csv,
    to_markdown,
)
from symsteer.bench.audit.result import AuditResult, AuditSettings, check_group
from symsteer.bench.tasks import TASKS
from symsteer.bench.variants import VARIANTS

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


def broken(result: AuditResult, unbroken: AuditResult) -> set[str]:
    """The components in which a result differs from the unbroken one: intervals do not overlap."""
    found = set()
    for row, other in zip(result.dynamics, unbroken.dynamics, strict=True):
        for measure in ("mm", "degrees"):
            if getattr(row, measure).low > getattr(other, measure).high:
                found.add("dynamics")
    if max(result.reward["cost"].value, result.reward["dense"].value) > EXACT:
        found.add("reward")
    if result.observation.value > EXACT:
        found.add("observation")
    if result.resets_p < SIGNIFICANT and result.resets.low > 0:
        found.add("resets")
    return found


def relative(result: AuditResult, body: str = "tool", window: str = "step") -> float:
    return result.defect(body, window).relative.value


def test_unbroken(place):
    result = place()
    print(text(result))
    for window in ("step", "chunk"):
        assert result.defect("tool", window).relative.high < 0.02
        assert result.defect("tool", window).floor_mm < 1e-3
        # A held cube goes with the gripper; a pushed one need not (see docs/audit.md).
        assert result.defect("object", window).relative.high < 0.02
    # Something was compared: the copies are not the same numbers, and they move.
    assert result.defect("tool").mm.value > 1e-4
    assert result.defect("tool").displacement_mm > 10
    assert broken(result, result) == set()
    assert result.unreachable == 0
    assert 8 <= result.moving < result.states == 16


def test_reflections_of_the_unbroken(place):
    result = place(group="D4")
    assert result.defect("tool").relative.high < 0.02
    assert broken(result, result) == set()


def test_action_gain_is_seen_in_proportion(place):
    unbroken, half, full = place(), place("action_gain:0.5"), place("action_gain:1")
    assert relative(unbroken) < relative(half) < relative(full)
    assert relative(unbroken, "object", "chunk") < relative(half, "object", "chunk")
    assert half.defect("tool").relative.high < full.defect("tool").relative.high
    for result in (half, full):
        assert broken(result, unbroken) == {"dynamics"}
    assert full.defect("tool").mm.value == pytest.approx(2 * half.defect("tool").mm.value, rel=0.1)


def test_action_gain_has_the_size_that_it_must_have(place):
    """With one axis scaled by k, turning a step d by t moves its end by (1 - k) |sin t| |d|."""
    experiment = Experiment(place.reference, "none", check_group("C8"), place.visited, 0)
    positions = experiment.copies().positions["tool"]
    experiment.close()
    # The commanded share of the step: less what the tool does by itself, its velocity's rest.
    horizontal = (positions[:, 0, 1] - positions[:, 0, 0])[:, :2].norm(dim=-1).mean().item()
    turns = np.abs(np.sin(np.arange(1, 8) * np.pi / 4)).mean()
    expected = 0.6 * turns * 1e3 * horizontal
    found = place("action_gain:1").defect("tool").mm.value
    assert found == pytest.approx(expected, rel=0.2)


def test_perception_bias_has_the_size_that_it_must_have(place):
    """Root mean square over C8 of the difference of b and its turned image: b sqrt(2 + 2/7)."""
    result = place("perception_bias:1")
    assert broken(result, place()) == {"observation"}
    assert result.worst_field.value.value == pytest.approx(20 * np.sqrt(16 / 7), rel=1e-4)
    # Against the unbroken spread, so in proportion to the strength.
    half = place("perception_bias:0.5")
    assert result.observation.value == pytest.approx(2 * half.observation.value, rel=1e-3)
    seen = {f.name for f in result.fields if f.value.value > 1e-2}
    assert seen == {"cube_xy", "tcp_to_cube_xy", "cube_to_goal_xy"}


def test_random_observations_are_compared_as_distributions(place):
    result = place("observation_noise:1")
    assert result.random_observation
    assert not place().random_observation
    assert broken(result, place()) == {"observation"}
    assert {f.name for f in result.fields if f.relative is not None and f.relative > 0.02} <= {
        "cube_xy",
        "cube_yaw",
        "cube_z",
        "tcp_to_cube_xy",
        "tcp_to_cube_z",
        "cube_to_goal_xy",
        "cube_to_goal_z",
        "grasp_yaw_cos",
        "grasp_yaw_sin",
    }


def test_a_shifted_origin_breaks_the_resets_alone(place):
    result = place("frame_offset:1")
    assert np.hypot(*result.origin_mm) == pytest.approx(50, abs=0.01)
    assert broken(result, place()) == {"resets"}


def test_results_repeat_and_survive_a_file(place):
    result = place("action_gain:1")
    again = audit(result.settings, place.reference, place.visited)
    assert dataclasses.replace(again, seconds=0) == dataclasses.replace(result, seconds=0)
    data = json.loads(json.dumps(result.to_json()))
    assert AuditResult.from_json(data).to_json() == data
    row = summary(result)
    assert row["variant"] == "action_gain:1"
    table = to_csv([row]).splitlines()
    assert len(table[0].split(",")) == len(table[1].split(","))
    assert "action_gain:1" in to_markdown([row])


def test_map_shows_where(place):
    result = place("action_gain:1")
    assert sum(b.copies for b in result.map if b.body == "tool") == 8 * result.states
    assert max(b.mm for b in result.map) > 5
    assert map_figure(result).axes


@pytest.mark.slow
@pytest.mark.parametrize("task", TASKS.names())
def test_unbroken_tasks(task):
    place = Place(dataclasses.replace(QUICK, task=task, count=32, resets=256))
    for group in ("C8", "D4"):
        result = place(group=group)
        print(text(result))
        for window in ("step", "chunk"):
            assert result.defect("tool", window).relative.value < 0.02
        assert broken(result, result) == set()


MOVES = {
    "gravity_tilt": "dynamics",
    "wind": "dynamics",
    "action_gain": "dynamics",
    "actuator_offset": "dynamics",
    "friction_patch": "dynamics",
    "obstacle": "dynamics",
    "perception_bias": "observation",
    "frame_offset": "resets",
    "frame_rotation": "observation",
    "directional_reward": "reward",
    "spawn_sector": "resets",
    "observation_noise": "observation",
}
"""The one component that each variant breaks (docs/variants.md)."""


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(VARIANTS))
def test_variants_move_what_they_claim_to_move(name, pushing):
    unbroken = pushing()
    half, full = pushing(f"{name}:0.5"), pushing(f"{name}:1")
    # Every rotation is still a symmetry of a turned observation; reflections are not.
    claimed = set() if name == "frame_rotation" else {MOVES[name]}
    for result in (half, full):
        print(text(result))
        assert broken(result, unbroken) == claimed
    if not claimed:
        mirrored = pushing(f"{name}:1", group="D4")
        assert broken(mirrored, pushing(group="D4")) == {MOVES[name]}
    size = {
        "dynamics": lambda c: max(d.mm.value for d in c.dynamics),
        "reward": lambda c: c.reward["cost"].value,
        "observation": lambda c: c.observation.value,
        "resets": lambda c: c.resets.value,
    }
    for component in claimed:
        assert size[component](half) < size[component](full)


@pytest.fixture(scope="module")
def pushing():
    place = Place(dataclasses.replace(QUICK, task="PushCube-v1", count=48, resets=256))
    yield place
    place.reference.close()


@pytest.mark.slow
def test_the_arm_breaks_the_dynamics():
    place = Place(dataclasses.replace(QUICK, embodiment="panda", count=32))
    result = place()
    print(text(result))
    assert result.defect("tool").relative.low > 0.05
    assert result.observation.value < EXACT
    assert result.unreachable < 0.1
