"""Variants that act on bodies: forces, friction, a post."""

import math

import pytest
import torch

from symsteer.bench.tasks import make
from symsteer.bench.variants.friction_patch import CENTER
from symsteer.bench.variants.obstacle import GAP, HALF_WIDTH
from tests.bench.shared import FLAT_TASKS
from tests.bench.variants.scenes import CONTROL_STEP, G, act, place, scene

STRENGTHS = torch.tensor([0.0, 0.5, 1.0])


def test_tilt_turns_the_gravity_of_all_objects_and_not_of_the_hand():
    env = scene("gravity_tilt", STRENGTHS, task="StackCube-v1")
    state = env.get_state_dict()
    for i, name in enumerate(("cubeA", "cubeB")):
        state["actors"][name][:, :3] = torch.tensor([0.25, 0.2 * (1 + i), 0.5])
    env.set_state_dict(state)
    tool = env.agent.tcp_pose.p.clone()
    for _ in range(3):
        env.step(act(env))
    tilt = math.radians(30) * STRENGTHS
    direction = torch.stack([tilt.sin(), torch.zeros(3), -tilt.cos()], dim=1)
    for cube in (env.cubeA, env.cubeB):
        assert torch.allclose(cube.linear_velocity, 3 * CONTROL_STEP * G * direction, atol=2e-3)
    assert torch.allclose(env.agent.tcp_pose.p, tool, atol=1e-4)


def test_stacked_cubes_rest_on_a_slope():
    """ManiSkill's test of rest sees it too; steeper than 27 degrees the stack tips over."""
    env = scene("gravity_tilt", torch.tensor([0.0, 0.5, 1.0]), task="StackCube-v1")
    state = env.get_state_dict()
    for name, height in (("cubeA", 0.06), ("cubeB", 0.02)):
        state["actors"][name][:] = torch.tensor([0.0, 0.2, height, 1.0] + 9 * [0.0])
    env.set_state_dict(state)
    for _ in range(25):
        info = env.step(act(env, z=1.0))[-1]
    assert info["is_cubeA_static"][:2].all()
    assert info["is_cubeA_on_cubeB"].tolist() == [True, True, False]


@pytest.mark.parametrize(
    "variant",
    [
        "gravity_tilt:1",
        pytest.param("wind:1", marks=pytest.mark.slow),
        pytest.param("wind:1+gravity_tilt:0.5", marks=pytest.mark.slow),
        pytest.param("wind:1+gravity_tilt:1", marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("task", FLAT_TASKS)
def test_untouched_objects_stay(task, variant):
    """Within 1 mm over a whole episode; also a sphere, which does not roll there."""
    env = make(task, num_envs=2, variant=variant)
    env.reset(seed=[0, 1])
    before = {body.name: body.pose.p.clone() for body in env.moving_bodies}
    for _ in range(env.max_episode_steps):
        env.step(act(env, z=1.0))
    for body in env.moving_bodies:
        assert (body.pose.p - before[body.name]).norm(dim=1).max() < 1e-3, body.name
    env.close()


def test_sphere_rolls_where_nothing_acts():
    env = scene("gravity_tilt", STRENGTHS, task="PlaceSphere-v1")
    place(env, (0.0, 0.25, env.radius), (0.2, 0.0, 0.0))
    for _ in range(4):
        env.step(act(env, z=1.0))
    speed = env.manipulated.linear_velocity[:, 0]
    assert speed[0] > 0.1
    assert torch.allclose(speed[1:], torch.zeros(2), atol=1e-2)


def test_wind_blows_on_the_manipulated_object_alone():
    env = scene("wind", STRENGTHS, task="StackCube-v1")
    other = env.cubeB.pose.p.clone()
    place(env, (0.25, 0.25, 0.5))
    for _ in range(3):
        env.step(act(env))
    expected = torch.zeros(3, 3)
    expected[:, 0] = 0.75 * 0.3 * STRENGTHS * G * 3 * CONTROL_STEP
    expected[:, 2] = -G * 3 * CONTROL_STEP
    assert torch.allclose(env.manipulated.linear_velocity, expected, atol=2e-3)
    assert torch.allclose(env.cubeB.pose.p, other, atol=1e-4)


def test_rough_patch_stops_what_slides_over_it():
    """Deceleration is friction times g: inside the region it is higher, outside as ever."""
    env = scene("friction_patch", STRENGTHS)
    speed = {}
    for x in (CENTER[0], -CENTER[0]):
        place(env, (x, 0.0, env.cube_half_size), (0.0, 0.5, 0.0))
        env.step(act(env, z=1.0))
        speed[x] = env.manipulated.linear_velocity[:, 1].clone()
    lost = 0.5 - speed[CENTER[0]]
    expected = CONTROL_STEP * G * (0.3 + 0.75 * STRENGTHS)
    assert torch.allclose(lost, expected.clamp(max=0.5), atol=0.03)
    assert torch.allclose(speed[-CENTER[0]], speed[CENTER[0]][:1].expand(3), atol=1e-4)


def test_patch_and_tilt_add_their_friction():
    env = scene("friction_patch:1+gravity_tilt:1")
    shape = env.manipulated._bodies[0].collision_shapes[0]
    tilt = 1.5 * math.tan(math.radians(30))
    for x, patch in ((CENTER[0], 1.5), (-CENTER[0], 0.0)):
        place(env, (x, 0.0, env.cube_half_size))
        env.step(act(env, z=1.0))
        assert shape.physical_material.static_friction == pytest.approx(0.3 + tilt + patch)
        assert shape.physical_material.dynamic_friction == pytest.approx(0.3 + tilt + patch)
        assert (env.manipulated.pose.p[:, 0] - x).abs().max() < 1e-3
    table = env.table_scene.table._bodies[0].collision_shapes[0]
    assert table.physical_material.static_friction == pytest.approx(0.3 + tilt)


def test_post_blocks_the_hand():
    env = scene("obstacle", STRENGTHS)
    env.reset(seed=[4, 4, 4])
    face = env.spawn_extent + GAP + HALF_WIDTH * (1 - STRENGTHS)
    place(env, (-0.2, 0.0, env.cube_half_size))
    xy = env.action_layout.slice("xy")
    for _ in range(12):
        action = act(env, z=-1.0, gripper=-1.0)
        action[:, xy] = -env.agent.tcp_pose.p[:, :2] / env.body.horizontal_step
        env.step(env.body.bound(action))
    for _ in range(14):
        env.step(act(env, xy=(1.0, 0.0), gripper=-1.0))
    x = env.agent.tcp_pose.p[:, 0]
    assert x[0] > face[0] + 0.1
    assert (x[1:] < face[1:]).all()
    assert x[2] < x[1]


def test_post_is_no_part_of_the_state():
    plain, env = scene(num_envs=3), scene("obstacle", STRENGTHS)
    state = env.get_state_dict()
    assert {k: set(v) for k, v in state.items()} == {
        k: set(v) for k, v in plain.get_state_dict().items()
    }
    env.set_state_dict(plain.get_state_dict())
    plain.set_state_dict(state)
    env.set_state_dict(env.transform_state(state, math.pi / 4))
    posts = [a for a in env.scene.actors.values() if a.name.startswith("obstacle")]
    assert {a.px_body_type for a in posts} == {"static"}
    for post in posts:
        expected = torch.tensor(env.variants[0].position)
        assert torch.allclose(post.pose.p[:, :2], expected.expand(len(post.pose.p), 2))
