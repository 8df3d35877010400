"""A tilted table: the flat task's physics, in a frame that turns with the table."""

import json
import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from symsteer.bench.audit.defects import audit, reference_task, visit_all
from symsteer.bench.audit.result import AuditSettings
from symsteer.bench.demos import collect, load
from symsteer.bench.sim.rotations import (
    quaternion_multiply,
    quaternion_to_matrix,
    wrap,
    yaw_quaternion,
)
from symsteer.bench.sim.trees import map_trees, rows_of
from symsteer.bench.tasks import make, task_class
from symsteer.bench.tasks.features import GRASP_YAW
from symsteer.bench.tasks.tilted import in_space
from symsteer.errors import UserError
from symsteer.policies.geometry import Field, Group
from tests.bench.shared import assert_same, shared

TASKS = ["PickCube-v1", "PushCube-v1"]
PLACES = [("PickCube-v1", "panda"), ("PushCube-v1", "floating")]
LEVEL = torch.tensor([1.0, 0.0, 0.0, 0.0])


def turns(count, seed=0):
    """Any rotations of space as quaternions, ``[count, 4]``."""
    xyzw = torch.tensor(Rotation.random(count, random_state=seed).as_quat())
    return xyzw[:, [3, 0, 1, 2]].float()


def reframed(env, frame):
    """Turn the worlds of all environments: the bodies stay, the frame is another."""
    frame = torch.as_tensor(frame).expand(env.num_envs, 4)
    env.set_state_dict({**env.get_state_dict(), "frame": frame})
    return env.get_obs().clone()


def random_actions(count, steps, seed=0):
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(steps, count, 7, generator=generator) * 2 - 1


def bodies(env):
    """Robot and actors; they are those of the flat task."""
    return {kind: env.get_state_dict()[kind] for kind in ("actors", "articulations")}


def close(value, other):
    """Poses and joint angles; velocities are less smooth."""
    poses = slice(0, 7 if value.shape[1] == 13 else (13 + value.shape[1]) // 2)
    assert torch.allclose(value[:, poses], other[:, poses], atol=2e-4)


def vector(env, obs, name):
    parts = [obs[:, env.observation_layout.slice(f"{name}_{end}")] for end in ("xy", "z")]
    return torch.cat(parts, dim=1)


@pytest.mark.parametrize(("task", "embodiment"), PLACES)
def test_bodies_start_as_in_the_flat_task(task, embodiment):
    """Also in later episodes, and where a variant draws its strength from the same key."""
    settings = {"embodiment": embodiment, "variant": "wind:0.2..0.8"}
    flat, tilted = (make(name, num_envs=4, **settings) for name in (task, f"Tilted{task}"))
    for options in ({}, {"env_idx": [2, 0]}, {"reconfigure": True}):
        for seed in (list(range(len(options.get("env_idx", range(4))))), None):
            for env in (flat, tilted):
                env.reset(seed=seed, options=dict(options))
            assert_same(bodies(flat), bodies(tilted))
            assert torch.equal(flat.variants[0].amount, tilted.variants[0].amount)
    strength = (tilted.variants[0].amount - 0.2) / 0.6
    height = (2 * tilted.frame[:, 1:].square().sum(dim=1)) / (1 - math.cos(math.radians(30)))
    assert (strength - height).abs().max() > 0.1  # from other random numbers


def test_the_normal_is_uniform_on_a_cap():
    env = shared("TiltedPushCube-v1", 50)
    obs = torch.cat([env.reset(seed=[*range(i, i + 50)])[0].clone() for i in range(0, 500, 50)])
    normal = vector(env, obs, "normal").double()
    assert torch.allclose(normal.norm(dim=1), torch.ones(500).double())
    # Archimedes: the height of a uniform point of a sphere is uniform.
    share = ((1 - normal[:, 2]) / (1 - math.cos(math.radians(30)))).sort().values
    assert share[0] >= 0
    assert share[-1] <= 1 + 1e-5
    steps = torch.arange(1, 501) / 500
    assert (share - steps).abs().max() < 1.63 / 500**0.5  # Kolmogorov and Smirnov, 1 %
    bearing = torch.atan2(normal[:, 1], normal[:, 0])
    for k in (1, 2, 4, 8):
        assert torch.polar(torch.ones(500).double(), k * bearing).mean().abs() < 3 / 500**0.5
    # The smallest rotation that leads there does not turn about the normal.
    assert env.frame[:, 3].abs().max() == 0


def test_each_episode_has_its_own_frame_and_a_seed_determines_it():
    env, other = shared("TiltedPickCube-v1", 4), shared("TiltedPickCube-v1", 3)
    env.reset(seed=[1, 2, 3, 4])
    first = env.frame.clone()
    other.reset(seed=[3, 2, 1])
    assert torch.equal(other.frame, first[:3].flip(0))
    env.reset(options={"env_idx": [1]})
    assert torch.equal(env.frame[[0, 2, 3]], first[[0, 2, 3]])
    assert not torch.equal(env.frame[1], first[1])
    env.reset()
    assert (env.frame != first).any(dim=1).all()


@pytest.mark.parametrize("task", TASKS)
def test_a_level_table_is_the_flat_task_to_the_bit(task):
    flat, tilted = shared(task, 4), shared(f"Tilted{task}", 4)
    for env in (flat, tilted):
        env.reset(seed=[5, 6, 7, 8])
    reframed(tilted, LEVEL)
    flat.set_state_dict(flat.get_state_dict())
    for action in random_actions(4, 12):
        theirs, reward, *_ = flat.step(action)
        obs, again, *_ = tilted.step(action)
        assert_same(bodies(flat), bodies(tilted))
        assert torch.equal(reward, again)
    seen = 0
    for field in flat.observation_layout.fields:
        name = field.name
        name += "_xy" * name.endswith("_axis")
        if field.frequency < 2:
            seen += field.dim
            assert torch.equal(
                obs[:, tilted.observation_layout.slice(name)],
                theirs[:, flat.observation_layout.slice(field.name)],
            ), name
    assert seen == flat.observation_layout.dim - 2


@pytest.mark.parametrize(("task", "embodiment"), PLACES)
def test_turned_actions_in_a_turned_world_do_the_same(task, embodiment):
    """For frames of the task and for any rotation of space."""
    flat, tilted, level = (
        shared(name, 6, number, embodiment=embodiment)
        for number, name in enumerate((task, f"Tilted{task}", f"Tilted{task}"))
    )
    for env in (flat, tilted):
        env.reset(seed=list(range(6)))
    frames = tilted.frame.clone()
    frames[3:] = turns(3)
    reframed(tilted, frames)
    matrix = quaternion_to_matrix(frames)
    layout = tilted.observation_layout
    for action in random_actions(6, 10, seed=1):
        flat.step(action)
        obs, *_ = tilted.step(tilted.action_layout.turn(action, matrix))
        map_trees(close, bodies(flat), bodies(tilted))
        level.set_state_dict({**flat.get_state_dict(), "frame": LEVEL.expand(6, 4)})
        assert torch.allclose(obs, layout.turn(level.get_obs(), matrix), atol=2e-4)


def test_all_but_three_numbers_are_vectors():
    layout = task_class("TiltedPushCube-v1").observation_layout
    inside = {name for pair in layout.spatial_vectors() for name in pair}
    outside = {field.name for field in layout.fields} - inside
    assert outside == {"gripper_width", "grasp_yaw_cos", "grasp_yaw_sin"}


def test_a_cubes_yaw_is_known_from_the_fingers():
    """What stands in place of its yaw turns four times as fast, and not with the world."""
    env = shared("TiltedPushCube-v1", 3)
    env.reset(seed=[0, 0, 0])
    state = env.get_state_dict()
    yaw = torch.tensor([0.0, 0.1, math.pi / 2])
    cube = state["actors"]["cube"]
    cube[:, 3:7] = quaternion_multiply(yaw_quaternion(yaw), cube[:, 3:7])
    env.set_state_dict(state)
    cos, sin = (env.get_obs()[:, env.observation_layout.slice(f.name)] for f in GRASP_YAW)
    turn = torch.atan2(sin, cos)[:, 0]
    assert torch.allclose(wrap(turn - turn[0] - 4 * yaw, math.tau), torch.zeros(3), atol=1e-4)


def test_rows_of_a_state_bring_their_frames_and_a_state_without_one_is_refused():
    env = shared("TiltedPickCube-v1", 4)
    env.reset(seed=[1, 2, 3, 4])
    state = env.get_state_dict()
    env.reset(seed=[5, 6, 7, 8])
    kept = env.frame[[1, 3]].clone()
    env.set_state_dict(rows_of(state, [0, 1]), torch.tensor([2, 0]))
    assert torch.equal(env.frame[[2, 0]], state["frame"][[0, 1]])
    assert torch.equal(env.frame[[1, 3]], kept)
    with pytest.raises(UserError, match="'frame'; take states from its own get_state_dict, not"):
        env.set_state(env.get_state())


def test_turning_a_state_keeps_the_smallest_rotation():
    """A turned episode is one that the task may draw: its frame has no heading of its own."""
    env = shared("TiltedPickCube-v1", 4)
    env.reset(seed=[1, 2, 3, 4])
    for element in Group.parse("D4").elements:
        turned = env.transform_state(env.get_state_dict(), *element)["frame"]
        assert torch.allclose(turned[:, 0], env.frame[:, 0])
        assert turned[:, 3].abs().max() < 1e-6


def test_demonstrations_are_in_the_laboratory_and_succeed_again(tmp_path):
    name = "TiltedPickCube-v1"
    path = collect(name, "floating", 3, "clean", 3, tmp_path / "demos.h5")
    demos = load(path, name, "floating")
    layout = demos.action_layout
    lengths = torch.cat([a for _, a in demos.episodes])[:, layout.slice("xy").start : 3].norm(dim=1)
    assert 0.9 < lengths.max() <= 1 + 1e-5
    env = shared(name, 3)
    records = json.loads(path.with_suffix(".json").read_text())["episodes"]
    obs, _ = env.reset(seed=[r["episode_seed"] for r in records])
    assert torch.equal(obs, torch.stack([seen[0] for seen, _ in demos.episodes]))
    actions = torch.nn.utils.rnn.pad_sequence([a for _, a in demos.episodes])
    solved = torch.stack([env.step(action)[-1]["success"] for action in actions])
    assert solved.any(dim=0).all()


@pytest.mark.long
@pytest.mark.parametrize("embodiment", ["floating", pytest.param("panda", marks=pytest.mark.slow)])
def test_the_audit_measures_the_flat_tasks_physics(embodiment):
    """Turns about the laboratory's vertical turn the bodies about the normal."""

    def result(task, variant="none"):
        settings = AuditSettings(
            task=task, embodiment=embodiment, variant=variant, states="expert", count=8, resets=32
        )
        reference = reference_task(settings)
        try:
            return audit(settings, reference, visit_all(reference, settings, None))
        finally:
            reference.close()

    tilted = result("TiltedPickCube-v1")
    seen = {field.name: field.value.value for field in tilted.fields}
    assert max(seen.values()) < 0.01, seen
    units = {field.name: field.unit for field in tilted.fields}
    assert (units["tcp_xy"], units["normal_xy"], units["tcp_x_axis_z"]) == ("mm", "", "")
    if embodiment == "floating":
        assert tilted.decision.high < 0.02
        assert result("TiltedPickCube-v1", "action_gain:1").decision.value > 0.1
    else:
        flat = result("PickCube-v1").decision.value
        assert tilted.decision.value == pytest.approx(flat, rel=0.5)


def test_a_vector_without_a_place_in_space_is_refused():
    layout = task_class("TiltedPickCube-v1").observation_layout
    assert layout.spatial_vectors()[0] == ("normal_xy", "normal_z")
    assert len(layout.spatial_vectors()) == 9
    fields = (Field("goal_xy", 1), Field("bar", 2), Field("width", 0))
    assert [field.name for field in in_space(fields)] == ["goal_xy", "goal_z", "width"]
    with pytest.raises(UserError, match="'push' has no place in space; name it push_xy"):
        in_space((*fields, Field("push", 1)))
