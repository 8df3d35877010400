"""Tasks that are seen from above: the map is right, turns with the scene, and is learned from."""

import math
from types import SimpleNamespace

import pytest
import sapien.physx as physx
import torch
from mani_skill.utils.structs import Pose

from symsteer.bench.demos import collect, load
from symsteer.bench.sim.headless import rendering_works
from symsteer.bench.tasks import make, task_class
from symsteer.bench.tasks.heights import SIDE
from symsteer.bench.tasks.solids import solids_of
from symsteer.errors import UserError
from symsteer.leaderboard.records import read_record
from symsteer.policies.geometry import Layout
from symsteer.policies.picture import PIXEL
from tests.bench.tiny_run import execute, tiny_config

TASKS = ["HeightPushCube-v1", "HeightPickCube-v1"]


@pytest.fixture(scope="module", params=TASKS)
def seen(request):
    env = make(request.param, num_envs=3)
    yield env
    env.close()


def middle(heights):
    """Of what stands there, ``[N, 2]`` metres."""
    line = (torch.arange(SIDE) + 0.5) * PIXEL - SIDE * PIXEL / 2
    total = heights.sum((1, 2))[:, None]
    return torch.stack([(heights.sum(1) * line).sum(1), -(heights.sum(2) * line).sum(1)], 1) / total


@pytest.mark.parametrize("task", TASKS)
def test_the_layout_has_a_map_and_no_pose_of_what_it_shows(task):
    layout = task_class(task).observation_layout
    assert (layout.picture.channels, layout.picture.side) == (("height",), SIDE)
    assert not any("cube" in field.name for field in layout.fields)
    assert {"tcp_xy", "goal_xy"} <= {field.name for field in layout.fields}


def test_the_map_shows_the_cube(seen):
    obs, _ = seen.reset(seed=[3, 4, 5])
    heights = seen.heights()
    assert torch.equal(obs[:, seen.observation_layout.picture.columns], heights.flatten(1))
    torch.testing.assert_close(heights.amax((1, 2)), torch.full((3,), 0.04), atol=1e-4, rtol=0)
    # Two rays in a row of each pixel: an eighth of the volume is a row of rays.
    torch.testing.assert_close(
        heights.sum((1, 2)) * PIXEL**2, torch.full((3,), 0.04**3), atol=1e-5, rtol=0
    )
    place = seen.manipulated.pose.p[:, :2]
    torch.testing.assert_close(middle(heights), place, atol=0.002, rtol=0)


def test_a_quarter_turn_turns_pixels_into_pixels(seen):
    layout = seen.observation_layout
    obs, _ = seen.reset(seed=[3, 4, 5])
    state = seen.get_state_dict()
    for angle, reflect, bound in (
        (math.pi / 2, False, 1e-4),
        (math.pi, True, 1e-4),
        (0.7, False, 0.4),
    ):
        seen.set_state_dict(seen.transform_state(state, angle, reflect))
        there, turned = seen.get_obs(), layout.transform(obs, angle, reflect)
        error, size = (layout.picture.of(x).norm() for x in (there - turned, turned))
        assert error < bound * size
        assert bound < 0.1 or error > 0.05 * size
        rest = layout.picture.rest_columns
        torch.testing.assert_close(there[:, rest], turned[:, rest], atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("variant", "shift", "angle"),
    [
        ("perception_bias:1", (0.02, 0.0), 0.0),
        ("frame_offset:1", (-0.05, 0.0), 0.0),
        ("camera_rotation:1", (0.0, 0.0), math.radians(10)),
    ],
)
def test_variants_of_perception_move_the_map(variant, shift, angle):
    envs = [make(TASKS[0], num_envs=2, variant=name) for name in ("none", variant)]
    for env in envs:
        env.reset(seed=[5, 6])
    plain, moved = (middle(env.heights()) for env in envs)
    turned = Layout(task_class("PushCube-v1").observation_layout.fields[:1]).transform(plain, angle)
    torch.testing.assert_close(moved, turned + torch.tensor(shift), atol=0.002, rtol=0)
    tools = [env.get_obs()[:, :2] for env in envs]
    told = torch.tensor(shift if variant.startswith("frame") else (0.0, 0.0))
    torch.testing.assert_close(tools[1] - tools[0], told.expand(2, 2))


def test_an_obstacle_is_seen_where_there_is_one():
    env = make(TASKS[1], num_envs=2, variant="obstacle", strength=torch.tensor([0.0, 1.0]))
    env.reset(seed=[0, 1])
    highest = env.heights().amax((1, 2))
    torch.testing.assert_close(highest, torch.tensor([0.04, 0.2]), atol=1e-4, rtol=0)


def test_a_shape_without_facets_is_refused():
    body = SimpleNamespace(name="ball", _bodies=[SimpleNamespace(collision_shapes=[object()])])
    with pytest.raises(UserError, match="needs boxes, cylinders and convex meshes, and ball"):
        list(solids_of(body))


def test_a_lying_cylinder_is_round():
    shape = physx.PhysxCollisionShapeCylinder(0.1, 0.2, physx.get_default_material())
    body = SimpleNamespace(name="roll", _bodies=[SimpleNamespace(collision_shapes=[shape])])
    (solid,) = solids_of(body)
    pose = Pose.create(torch.tensor([[0.0, 0, 0.1, 1, 0, 0, 0]]))
    line = torch.tensor([-0.25, -0.1, 0.0, 0.15])
    y, zero = torch.tensor([0.0, 0.06, 0.11])[None, :, None], torch.zeros(1, 1, 1)
    _, top = solid.span(pose, (line[None, None], y, zero), (zero, zero, zero + 1))
    top = top[0].clamp_min(0)
    assert (top[2] == 0).all()
    assert (top[:, 0] == 0).all()
    torch.testing.assert_close(top[0, 1:], torch.full((3,), 0.2), atol=0.002, rtol=0)
    torch.testing.assert_close(top[1, 1:], torch.full((3,), 0.18), atol=0.002, rtol=0)


@pytest.mark.skipif(not rendering_works(), reason="needs a Vulkan driver")
@pytest.mark.slow
def test_the_map_is_what_depth_cameras_see():
    """The tops that the four cameras of SeenPushCube see lie on the map of the same state."""
    cameras, env = (make(task, num_envs=2) for task in ("SeenPushCube-v1", TASKS[0]))
    for each in (cameras, env):
        each.reset(seed=[3, 4])
    torch.testing.assert_close(cameras.get_state(), env.get_state())
    cloud, heights = cameras.cloud(), env.heights()
    top = cloud[:, :, 2] > 0.038
    column = ((cloud[:, :, 0] / PIXEL) + SIDE / 2).long()
    row = (SIDE / 2 - cloud[:, :, 1] / PIXEL).long()
    there = torch.stack([heights[i, row[i], column[i]] for i in range(2)])
    # At an edge the body fills only a part of a pixel, and depths are rounded to 1 mm.
    assert (there[top] > 0.039).float().mean() > 0.5
    around = torch.nn.functional.max_pool2d(heights, 3, stride=1, padding=1)
    assert (torch.stack([around[i, row[i], column[i]] for i in range(2)])[top] > 0).all()


@pytest.mark.slow
def test_a_policy_is_trained_on_maps_and_steered(tmp_path):
    path = collect(TASKS[0], "floating", 2, "diverse", 0, tmp_path / "demos.h5", num_envs=2)
    demos = load(path, TASKS[0], "floating")
    assert demos.episodes[0][0].shape[1] == demos.observation_layout.dim
    for agent in ("standard", "equivariant"):
        config = tiny_config(task=TASKS[0], env_steps=80, num_envs=2, agent=agent)
        folder = execute(config, tmp_path / "runs")
        record = read_record(folder / "record.json")
        assert record.status == "finished"
        assert record.base_policy.equivariance_error < 1e-4
