"""Tasks: observations follow their layouts, resets are seeded and symmetric, states turn."""

import math

import gymnasium as gym
import numpy as np
import pytest
import torch
from mani_skill.envs.tasks.tabletop.pick_cube import PickCubeEnv
from mani_skill.utils.registration import REGISTERED_ENVS
from sapien.physx import (
    PhysxCollisionShapeBox,
    PhysxCollisionShapeSphere,
    PhysxRigidBaseComponent,
)

from symsteer.bench.tasks import EMBODIMENTS, TASKS, make, task_class
from symsteer.errors import UserError
from symsteer.policies.geometry import Group
from tests.bench.state_tasks import STATE_TASKS

# Their observations are those of the world (test_tilted.py has the others).
FLAT = [name for name in STATE_TASKS if not name.startswith("Tilted")]
# Stock evaluates these with Euler angles; their own tests compare.
OWN_EVALUATE = {"LiftPegUpright-v1", "PokeCube-v1"}
ELEMENTS = [*Group.parse("D4").elements, (0.3, False), (-2.0, True)]


@pytest.fixture(scope="module", params=STATE_TASKS)
def floating(request):
    env = make(request.param, num_envs=6, reward_mode="dense")
    yield env
    env.close()


def roam(env, steps, seed=0):
    """Random actions, so that states are general: tilted, moving, fingers half open."""
    generator = torch.Generator().manual_seed(seed)
    for _ in range(steps):
        env.step(torch.rand(env.num_envs, 7, generator=generator) * 2 - 1)


def assert_same(a, b):
    if isinstance(a, dict):
        assert a.keys() == b.keys()
        for key in a:
            assert_same(a[key], b[key])
    else:
        assert torch.equal(a, b)


def rows(tree, index):
    if isinstance(tree, dict):
        return {key: rows(value, index) for key, value in tree.items()}
    return tree[index].clone()


def test_names():
    assert TASKS.names() == [
        "PushCube-v1",
        "PullCube-v1",
        "PickCube-v1",
        "StackCube-v1",
        "PlaceSphere-v1",
        "LiftPegUpright-v1",
        "PokeCube-v1",
        "PushT-v1",
        "TiltedPushCube-v1",
        "TiltedPickCube-v1",
        "SeenPushCube-v1",
        "SeenPickCube-v1",
    ]
    assert list(EMBODIMENTS) == ["floating", "panda"]


@pytest.mark.parametrize(
    ("arguments", "parts"),
    [
        ({"task": "PickCub-v1"}, ["PickCub-v1", "'PickCube-v1'", "StackCube-v1"]),
        ({"task": "PickCube-v1", "embodiment": "pand"}, ["'panda'", "floating"]),
        ({"task": "PickCube-v1", "variant": "action_gian:1"}, ["'action_gain'"]),
        ({"task": "PickCube-v1", "sim": "gpu"}, ["gpu", "cpu", "cuda"]),
        ({"task": "PickCube-v1", "num_envs": 0}, ["num_envs"]),
    ],
)
def test_bad_names_are_explained(arguments, parts):
    with pytest.raises(UserError) as error:
        make(**{"num_envs": 1, **arguments})
    for part in parts:
        assert part in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("task", FLAT)
def test_tasks_are_maniskills(task):
    ours, stock = task_class(task), REGISTERED_ENVS[task].cls
    assert stock.__module__.startswith("mani_skill.")
    assert issubclass(ours, stock)
    assert (ours.evaluate is stock.evaluate) == (task not in OWN_EVALUATE)


@pytest.mark.parametrize("embodiment", ["floating", "panda"])
@pytest.mark.parametrize("task", FLAT)
def test_observation_follows_the_layout(task, embodiment):
    env = make(task, num_envs=3, embodiment=embodiment)
    obs, _ = env.reset(seed=[1, 2, 3])
    layout = env.observation_layout
    assert obs.shape == (3, layout.dim)
    assert obs.dtype == torch.float32
    assert env.action_layout.dim == 7
    assert env.single_observation_space.shape == (layout.dim,)
    assert torch.equal(obs[:, layout.slice("tcp_xy")], env.agent.tcp_pose.p[:, :2])
    assert torch.equal(obs[:, layout.slice("tcp_z")], env.agent.tcp_pose.p[:, 2:])
    assert torch.allclose(obs[:, layout.slice("gripper_width")], torch.tensor(0.08), atol=1e-6)
    fields = env.get_obs(unflattened=True)
    for part in fields.values():
        for name, value in part.items():
            assert torch.equal(obs[:, layout.slice(name)], value), name


@pytest.mark.parametrize(
    ("task", "embodiment"),
    [
        *((task, "floating") for task in STATE_TASKS),
        ("PickCube-v1", "panda"),
        *(
            pytest.param(task, "panda", marks=pytest.mark.slow)
            for task in STATE_TASKS
            if task != "PickCube-v1"
        ),
    ],
)
def test_a_seed_alone_determines_the_initial_state(task, embodiment):
    many = make(task, num_envs=4, embodiment=embodiment)
    many.reset(seed=[11, 12, 13, 14])
    together = many.get_state_dict()
    one = make(task, num_envs=1, embodiment=embodiment)
    one.reset(seed=[13])
    assert_same(one.get_state_dict(), rows(together, slice(2, 3)))
    many.reset(seed=[0, 1, 2, 3])
    many.reset(seed=[13, 11], options={"env_idx": torch.tensor([3, 0])})
    again = many.get_state_dict()
    assert_same(rows(again, slice(3, 4)), rows(together, slice(2, 3)))
    assert_same(rows(again, slice(0, 1)), rows(together, slice(0, 1)))


def test_partial_reset_leaves_the_others_alone():
    def play(interfere):
        env = make("PickCube-v1", num_envs=3)
        env.reset(seed=[1, 2, 3])
        roam(env, 5)
        if interfere:
            env.reset(seed=[9], options={"env_idx": torch.tensor([1])})
        roam(env, 5, seed=1)
        kept = rows(env.get_state_dict(), [0, 2])
        # Unseeded resets continue each environment's own stream.
        env.reset()
        return kept, rows(env.get_state_dict(), [0, 2])

    for quiet, disturbed in zip(play(False), play(True), strict=True):
        assert_same(quiet, disturbed)


def test_wrong_number_of_seeds_is_explained():
    env = make("PickCube-v1", num_envs=3)
    with pytest.raises(UserError, match="2 seeds were given for 3 environments"):
        env.reset(seed=[1, 2])
    with pytest.raises(UserError, match="3 seeds were given for 2 environments"):
        env.reset(seed=[1, 2, 3], options={"env_idx": [0, 1]})


@pytest.mark.parametrize("task", STATE_TASKS)
def test_resets_have_no_preferred_direction(task):
    """In a distribution that rotations leave alone, E z^k = 0 for every vector z = x + i y.

    A square spawn region, or a yaw that is not uniform, fails for some k up to 8.
    """
    count = 400
    env = make(task, num_envs=count)
    obs, _ = env.reset(seed=list(range(count)))
    env.close()
    for field in env.observation_layout.fields:
        value = obs[:, env.observation_layout.slice(field.name)].double()
        if field.frequency == 0:
            if field.odd:  # reflections: as often this way as that way
                assert value.mean().abs() <= 5 * value.std() / count**0.5 + 1e-6, field.name
            continue
        z = torch.complex(value[:, 0], value[:, 1])
        if z.abs().max() < 1e-4:
            continue
        for k in (1, 2, 3, 4, 8):
            size = (z.abs() ** (2 * k)).mean().sqrt()
            assert (z**k).mean().abs() < 5 * size / count**0.5, (field.name, k)


@pytest.mark.parametrize("task", ["PushCube-v1", "PullCube-v1"])
def test_goal_lies_ahead_of_a_cube_in_a_disc(task):
    env = make(task, num_envs=200)
    obs, _ = env.reset(seed=list(range(200)))
    layout = env.observation_layout
    cube = obs[:, layout.slice("cube_xy")]
    assert cube.norm(dim=1).max() <= env.spawn_radius + 1e-6
    # Uniform in the disc: half of the points lie within radius / sqrt(2).
    inside = (cube.norm(dim=1) < env.spawn_radius / math.sqrt(2)).float().mean()
    assert 0.4 < inside < 0.6
    ahead = obs[:, layout.slice("cube_to_goal_xy")]
    assert torch.allclose(ahead, 0.2 * env.direction(), atol=1e-5)


def reach(actor):
    """Distance of the furthest point of a body from the vertical axis through the origin, [N]."""
    shapes = actor._objs[0].find_component_by_type(PhysxRigidBaseComponent).collision_shapes
    points = []
    for shape in shapes:
        if isinstance(shape, PhysxCollisionShapeSphere):
            turns = np.linspace(0, 2 * np.pi, 32)
            local = shape.radius * np.stack([np.cos(turns), np.sin(turns), 0 * turns], axis=1)
        elif isinstance(shape, PhysxCollisionShapeBox):
            corners = [(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
            local = np.array(corners) * shape.half_size
        else:
            local = shape.vertices * shape.scale
        pose = shape.local_pose.to_transformation_matrix()
        points.append(local @ pose[:3, :3].T + pose[:3, 3])
    body = torch.as_tensor(np.concatenate(points), dtype=torch.float32)
    world = actor.pose.to_transformation_matrix()
    placed = body @ world[:, :3, :3].transpose(1, 2) + world[:, None, :3, 3]
    return placed[..., :2].norm(dim=2).amax(dim=1)


@pytest.mark.parametrize("task", STATE_TASKS)
def test_everything_that_can_collide_stands_within_the_spawn_extent(task):
    env = make(task, num_envs=64)
    env.reset(seed=list(range(64)))
    furthest = [
        reach(actor).max().item()
        for name, actor in env.scene.actors.items()
        if "table" not in name
        and "ground" not in name
        and actor._objs[0].find_component_by_type(PhysxRigidBaseComponent).collision_shapes
    ]
    assert furthest
    assert max(furthest) <= env.spawn_extent
    # and not half the table: an obstacle outside of it must matter
    assert max(furthest) >= 0.75 * env.spawn_extent


def test_restoring_a_state(floating):
    """The state comes back to the bit, controller targets included, and goes on as before."""
    floating.reset(seed=list(range(6)))
    roam(floating, 4)
    state = rows(floating.get_state_dict(), slice(None))
    roam(floating, 6, seed=2)
    expected = rows(floating.get_state_dict(), slice(None))
    floating.set_state_dict(state)
    assert_same(rows(floating.get_state_dict(), slice(None)), state)
    roam(floating, 6, seed=2)
    now = floating.get_state_dict()
    assert torch.equal(
        now["controller"]["root"]["target_qpos"][:, 3:],
        expected["controller"]["root"]["target_qpos"][:, 3:],
    )
    # PhysX keeps contact caches of its own, which no state holds. In PushT the hand comes down on
    # the block, whose many solver iterations lean on them.
    tolerance = 1e-3 if floating.task_id == "PushT-v1" else 2e-5
    for kind in ("actors", "articulations"):
        for name, value in now[kind].items():
            positions = slice(0, 3) if kind == "actors" else slice(13, 21)
            close = torch.isclose(
                value[:, positions], expected[kind][name][:, positions], atol=tolerance
            )
            assert close.all(), name


def test_restoring_some_environments_keeps_the_others(floating):
    floating.reset(seed=list(range(6)))
    roam(floating, 3)
    before = rows(floating.get_state_dict(), slice(None))
    roam(floating, 3)
    after = rows(floating.get_state_dict(), slice(None))
    floating.set_state_dict(rows(before, [2, 3]), env_idx=torch.tensor([4, 1]))
    now = floating.get_state_dict()
    assert_same(rows(now, [0, 2, 3, 5]), rows(after, [0, 2, 3, 5]))
    assert_same(rows(now, [4, 1]), rows(before, [2, 3]))


def test_turning_a_state_turns_observation_and_keeps_the_reward(floating):
    """The layout says how each observed number turns; the simulation state must agree."""
    floating.reset(seed=list(range(6)))
    roam(floating, 8)
    state = rows(floating.get_state_dict(), slice(None))
    floating.set_state_dict(state)
    obs = floating.get_obs().clone()
    zero = torch.zeros(6, 7)
    reward = floating.get_reward(obs, zero, floating.get_info()).clone()
    for angle, reflect in ELEMENTS:
        floating.set_state_dict(floating.transform_state(state, angle, reflect))
        expected = floating.observation_layout.transform(obs.double(), angle, reflect)
        assert torch.allclose(floating.get_obs().double(), expected, atol=2e-5), (angle, reflect)
        turned = floating.get_reward(obs, zero, floating.get_info())
        assert torch.allclose(turned, reward, atol=1e-5)


def test_transformations_compose(floating):
    floating.reset(seed=list(range(6)))
    roam(floating, 8)
    state = floating.get_state_dict()
    there = floating.transform_state(state, 1.1, True)
    # A reflection followed by a rotation is its own inverse.
    back = floating.transform_state(there, 1.1, True)

    def compare(a, b):
        for key, value in a.items():
            if isinstance(value, dict):
                compare(value, b[key])
            else:
                assert torch.allclose(value, b[key], atol=5e-6), key

    compare(state, back)
    moved = there["articulations"][floating.agent.robot.name][:, 13:21]
    assert (moved - state["articulations"][floating.agent.robot.name][:, 13:21]).abs().max() > 0.1


def test_panda_states_cannot_be_turned():
    env = make("PickCube-v1", num_envs=1, embodiment="panda")
    with pytest.raises(UserError, match="floating"):
        env.transform_state(env.get_state_dict(), 0.5)


@pytest.mark.parametrize(("task", "angle"), [("PushCube-v1", 0.0), ("PullCube-v1", math.pi)])
def test_reward_in_the_stock_direction_is_maniskills(task, angle):
    env = make(task, num_envs=6, reward_mode="dense")
    env.reset(seed=list(range(6)))
    roam(env, 6)
    direction = env.direction()
    angles = angle - torch.atan2(direction[:, 1], direction[:, 0])
    # Turn every environment so that it moves along the stock direction.
    states = [env.transform_state(env.get_state_dict(), float(a)) for a in angles]
    row = [rows(state, slice(i, i + 1)) for i, state in enumerate(states)]

    def stack(trees):
        if isinstance(trees[0], dict):
            return {key: stack([tree[key] for tree in trees]) for key in trees[0]}
        return torch.cat(trees)

    state = stack(row)
    env.set_state_dict(state)
    # Bring some cubes to where the tool is right behind them, one of them into the goal.
    cube = state["actors"]["cube"]
    shift = env.cube_half_size + (0.005 if task == "PushCube-v1" else 0.01)
    ahead = torch.tensor([math.cos(angle), math.sin(angle), 0.0])
    cube[:3, :3] = env.agent.tcp_pose.p[:3] + shift * ahead
    state["actors"]["goal_region"][2, :2] = cube[2, :2]
    cube[2, 2] = env.cube_half_size
    env.set_state_dict(state)
    info = env.get_info()
    ours = env.compute_dense_reward(None, None, info)
    stock = REGISTERED_ENVS[task].cls.compute_dense_reward(env, None, None, info)
    assert torch.allclose(ours, stock, atol=1e-5)
    assert info["success"][2]
    assert len(ours.round(decimals=3).unique()) >= 5


def test_a_closed_environment_says_so():
    env = make("PushCube-v1", num_envs=1)
    env.reset(seed=[0])
    env.close()
    with pytest.raises(UserError, match="was closed"):
        env.step(torch.zeros(1, 7))
    with pytest.raises(UserError, match="was closed"):
        env.reset(seed=[0])


def test_truncation_at_the_limit():
    env = make("PickCube-v1", num_envs=2)
    env.reset(seed=[0, 1])
    for step in range(env.max_episode_steps):
        _, _, terminated, truncated, _ = env.step(torch.zeros(2, 7))
        assert truncated.tolist() == [step + 1 == env.max_episode_steps] * 2
        assert not terminated.any()


def test_gymnasium_makes_the_same_environment():
    env = gym.make(
        "SymSteer/PickCube-v1", num_envs=2, embodiment="floating", variant="action_gain", strength=1
    )
    base = env.unwrapped
    assert isinstance(base, PickCubeEnv)
    assert base.variants[0].name == "action_gain"
    obs, _ = env.reset(seed=[3, 4])
    ours = make("PickCube-v1", num_envs=2)
    assert torch.equal(obs, ours.reset(seed=[3, 4])[0])


def test_feasible_return():
    task = task_class("PickCube-v1")
    assert task.feasible_return(0.9, steps_per_decision=4) == pytest.approx((-40.0, 0.0))
    low, high = task.feasible_return(0.5, steps_per_decision=25, bootstrap_truncation=False)
    assert (low, high) == pytest.approx((-25 * (1 + 0.5), 0.0))
    assert task.feasible_return(1.0, bootstrap_truncation=False)[0] == -50
    with pytest.raises(UserError, match="gamma"):
        task.feasible_return(1.0)
    with pytest.raises(UserError, match="gamma"):
        task.feasible_return(-0.1)


@pytest.mark.parametrize("task", STATE_TASKS)
def test_observation_is_a_function_of_the_state(task):
    """Nothing in the observation depends on how the state came about (contacts, velocities)."""
    env = make(task, num_envs=4)
    env.reset(seed=[0, 1, 2, 3])
    roam(env, 10)
    obs, state = env.get_obs().clone(), rows(env.get_state_dict(), slice(None))
    other = make(task, num_envs=4)
    other.set_state_dict(state)
    assert np.allclose(other.get_obs(), obs, atol=1e-6)
