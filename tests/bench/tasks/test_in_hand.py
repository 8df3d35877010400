"""Tasks that a camera in the hand sees: the picture is right, turns not, is learned from."""

import math

import pytest
import torch

from symsteer.bench.demos import collect, load
from symsteer.bench.sim.rotations import quaternion_to_matrix
from symsteer.bench.tasks import make, task_class
from symsteer.bench.tasks.in_hand import MOUNT, SIDE
from symsteer.leaderboard.records import read_record
from symsteer.policies.picture import FIELD_OF_VIEW
from tests.bench.tiny_run import execute, tiny_config

TASKS = ["HandPushCube-v1", "HandPickCube-v1"]
HALF = 0.02


@pytest.fixture(scope="module", params=[(TASKS[0], "floating"), (TASKS[1], "panda")])
def seen(request):
    task, embodiment = request.param
    env = make(task, num_envs=3, embodiment=embodiment)
    yield env
    env.close()


def tilted(env, seeds):
    """The hand lower and leaning, each in its own way."""
    env.reset(seed=seeds)
    action = torch.zeros(env.num_envs, 7)
    action[:, 2] = -0.8
    action[:, 3:6] = torch.rand(env.num_envs, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    for _ in range(3):
        obs = env.step(action)[0]
    return obs


def slab(env):
    """The pictures of a cube by the slab method, ``[N, SIDE, SIDE]`` float64."""
    tcp, cube = env.agent.tcp_pose, env.manipulated.pose
    hand, box = (quaternion_to_matrix(pose.q).double() for pose in (tcp, cube))
    eye = tcp.p.double() + hand @ torch.tensor(MOUNT, dtype=torch.float64)
    eye = ((eye - cube.p)[:, None] @ box)[:, None]
    line = math.tan(FIELD_OF_VIEW / 2) * ((torch.arange(SIDE).double() * 2 + 1) / SIDE - 1)
    ahead = torch.stack([-line[:, None].expand(SIDE, SIDE), line.expand(SIDE, SIDE)], 2)
    ahead = torch.cat([ahead, torch.ones(SIDE, SIDE, 1)], 2)
    rays = torch.nn.functional.normalize(ahead, dim=2) @ (box.mT @ hand).mT[:, None]
    enter, leave = (torch.stack([-HALF - eye, HALF - eye]) / rays).sort(0).values
    enter, leave = enter.amax(3), leave.amin(3)
    return torch.where((enter < leave) & (leave > 0), enter, 0.0)


@pytest.mark.parametrize("task", TASKS)
def test_the_layout_has_a_picture_and_no_pose_of_what_it_shows(task):
    layout = task_class(task).observation_layout
    assert (layout.picture.channels, layout.picture.side) == (("distance",), SIDE)
    assert layout.picture.in_hand
    assert not any("cube" in field.name for field in layout.fields)
    assert {"tcp_xy", "tcp_x_axis", "goal_xy"} <= {field.name for field in layout.fields}


def test_the_picture_shows_the_cube_as_the_slab_method_does(seen):
    obs = tilted(seen, [3, 4, 5])
    distances = seen.distances()
    assert torch.equal(obs[:, seen.observation_layout.picture.columns], distances.flatten(1))
    wanted = slab(seen)
    there = (wanted > 0).sum((1, 2))
    assert ((there > 5) & (there < SIDE**2 / 4)).all()
    # A ray that grazes an edge may miss it.
    same = (distances > 0) == (wanted > 0)
    assert (~same).sum() <= 2
    torch.testing.assert_close(distances[same], wanted.float()[same], atol=1e-4, rtol=0)


@pytest.mark.parametrize("task", TASKS)
def test_the_picture_stays_when_scene_and_hand_turn(task):
    env = make(task, num_envs=3)
    layout, obs = env.observation_layout, tilted(env, [3, 4, 5])
    state = env.get_state_dict()
    for angle, reflect in ((0.7, False), (math.pi / 2, True), (2.5, True)):
        env.set_state_dict(env.transform_state(state, angle, reflect))
        there, turned = env.get_obs(), layout.transform(obs, angle, reflect)
        error = (there - turned).abs()
        # Rounding may move an edge over a pixel's ray.
        assert (error > 1e-4).sum() <= 2
        rest = layout.picture.rest_columns
        torch.testing.assert_close(there[:, rest], turned[:, rest], atol=1e-5, rtol=0)
    turned = env.distances()
    for _ in range(3):
        env.step(torch.tensor([[0.0, 0, 0, 0, 0, 1, 1]]).repeat(3, 1))
    assert (env.distances() - turned).abs().max() > 0.05


@pytest.mark.parametrize("variant", ["perception_bias:1", "camera_rotation:1", "frame_offset:1"])
def test_variants_of_perception_move_the_cube_before_the_camera(variant):
    envs = [make(TASKS[0], num_envs=2, variant=name) for name in ("none", variant)]
    plain, moved = envs
    obs = [tilted(env, [5, 6]) for env in envs]
    tool = obs[1][:, :2] - obs[0][:, :2]
    if variant.startswith("frame"):
        # The whole world is moved: all that changes is where the policy takes it to be.
        torch.testing.assert_close(moved.distances(), plain.distances(), atol=1e-4, rtol=0)
        torch.testing.assert_close(tool, torch.tensor([-0.05, 0.0]).expand(2, 2))
        return
    assert not tool.any()
    assert (moved.distances() - plain.distances()).abs().max() > 0.05
    seen = moved.seen(moved.manipulated.pose, "object")
    plain.manipulated.set_pose(seen)
    torch.testing.assert_close(moved.distances(), plain.distances(), atol=1e-4, rtol=0)


def test_an_obstacle_is_seen_where_there_is_one():
    env = make(TASKS[1], num_envs=2, variant="obstacle", strength=torch.tensor([0.0, 1.0]))
    env.reset(seed=[0, 0])
    without, with_it = (env.distances() > 0).sum((1, 2))
    assert with_it > without + 20


@pytest.mark.slow
def test_a_policy_is_trained_on_pictures_and_steered(tmp_path):
    path = collect(TASKS[0], "floating", 2, "diverse", 0, tmp_path / "demos.h5", num_envs=2)
    demos = load(path, TASKS[0], "floating")
    assert demos.episodes[0][0].shape[1] == demos.observation_layout.dim
    for agent in ("standard", "equivariant"):
        config = tiny_config(task=TASKS[0], env_steps=80, num_envs=2, agent=agent)
        folder = execute(config, tmp_path / "runs")
        record = read_record(folder / "record.json")
        assert record.status == "finished"
        assert record.base_policy.equivariance_error < 1e-4
