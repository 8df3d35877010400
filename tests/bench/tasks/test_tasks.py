"""Tasks: observations follow their layouts, resets are seeded and symmetric, states turn."""

import math

import numpy as np
import pytest
import torch
from mani_skill.envs.tasks.tabletop.pick_cube import PickCubeEnv
from mani_skill.utils.registration import REGISTERED_ENVS
from sapien.physx import PhysxCollisionShapeBox, PhysxCollisionShapeSphere

from symsteer.bench.sim.trees import join_trees, map_trees, rows_of
from symsteer.bench.tasks import make, task_class
from symsteer.bench.tasks.experts import Expert
from symsteer.errors import UserError
from symsteer.policies.geometry import Group
from tests.bench.shared import FLAT_TASKS, STATE_TASKS, assert_same, roam, shared

# Stock evaluates the first two with Euler angles; their own tests compare. The third may be brief.
OWN_EVALUATE = {"LiftPegUpright-v1", "PokeCube-v1", "PickCube-v1"}
ELEMENTS = [*Group.parse("D4").elements, (0.3, False), (-2.0, True)]


@pytest.fixture(scope="module", params=STATE_TASKS)
def task(request):
    """Tests of one task follow each other, so that they share its environments."""
    return request.param


@pytest.fixture
def floating(task):
    env = shared(task, reward_mode="dense")
    env.reset(seed=list(range(6)))
    return env


def copied(env):
    return map_trees(torch.clone, env.get_state_dict())


def test_an_unknown_task_is_explained():
    with pytest.raises(UserError, match="did you mean 'PickCube-v1'"):
        make("PickCub-v1", num_envs=1)


@pytest.mark.parametrize("task", [task for task in FLAT_TASKS if task in REGISTERED_ENVS])
def test_tasks_are_maniskills(task):
    ours, stock = task_class(task), REGISTERED_ENVS[task].cls
    assert stock.__module__.startswith("mani_skill.")
    assert issubclass(ours, stock)
    assert (ours.evaluate is stock.evaluate) == (task not in OWN_EVALUATE)


@pytest.mark.parametrize("embodiment", ["floating", "panda"])
def test_a_brief_evaluation_finds_maniskills_success(embodiment):
    env = shared("PickCube-v1", 8, embodiment=embodiment)
    env.reset(seed=list(range(8)))
    expert, found = Expert(env), []
    for _ in range(50):
        env.step(expert.act())
        stock = PickCubeEnv.evaluate(env)
        assert_same(env.evaluate(), stock)
        env.brief = True
        brief = env.evaluate()
        env.brief = False
        assert_same(brief, {"success": stock["success"]})
        found.append(stock)
    for part in ("success", "is_obj_placed", "is_robot_static"):
        assert 0 < torch.stack([stock[part] for stock in found]).float().mean() < 1


@pytest.mark.parametrize(
    ("task", "embodiment"), [*((task, "floating") for task in FLAT_TASKS), ("PokeCube-v1", "panda")]
)
def test_observation_follows_the_layout(task, embodiment):
    env = shared(task, 4, embodiment=embodiment)
    obs, _ = env.reset(seed=[1, 2, 3, 4])
    layout = env.observation_layout
    assert obs.shape == (4, layout.dim)
    assert obs.dtype == torch.float32
    assert env.single_observation_space.shape == (layout.dim,)
    assert torch.equal(obs[:, layout.slice("tcp_xy")], env.agent.tcp_pose.p[:, :2])
    assert torch.equal(obs[:, layout.slice("tcp_z")], env.agent.tcp_pose.p[:, 2:])
    assert torch.allclose(obs[:, layout.slice("gripper_width")], torch.tensor(0.08), atol=1e-6)
    for fields in env.get_obs(unflattened=True).values():
        for name, value in fields.items():
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
    many, one = (shared(task, count, embodiment=embodiment) for count in (4, 1))
    many.reset(seed=[11, 12, 13, 14])
    together = copied(many)
    one.reset(seed=[13])
    assert_same(one.get_state_dict(), rows_of(together, slice(2, 3)))
    many.reset(seed=[0, 1, 2, 3])
    many.reset(seed=[13, 11], options={"env_idx": torch.tensor([3, 0])})
    assert_same(rows_of(many.get_state_dict(), [3, 0]), rows_of(together, [2, 0]))


def test_unseeded_resets_continue_each_environments_own_stream():
    env, states = shared("PickCube-v1", 4), []
    for seeds in ([9], None):
        env.reset(seed=[1, 2, 3, 4])
        if seeds:
            env.reset(seed=seeds, options={"env_idx": torch.tensor([1])})
        env.reset()
        states.append(rows_of(copied(env), [0, 2, 3]))
    assert_same(*states)
    with pytest.raises(UserError, match="3 seeds were given for 2 environments"):
        env.reset(seed=[1, 2, 3], options={"env_idx": [0, 1]})


def test_resets_have_no_preferred_direction_and_stay_inside_the_spawn_extent(task):
    """In a distribution that rotations leave alone, E z^k = 0 for every vector z = x + i y.

    A square spawn region, or a yaw that is not uniform, fails for some k up to 8.
    """
    env, batch, furthest = shared(task, 40), [], []
    furniture = env.table_scene.table
    for start in range(0, 400, 40):
        batch.append(env.reset(seed=list(range(start, start + 40)))[0].clone())
        furthest += [
            reach(actor, actor._bodies[0].collision_shapes)
            for actor in env.scene.actors.values()
            if actor.px_body_type != "static" and actor is not furniture
            if actor._bodies[0].collision_shapes
        ]
    obs, count = torch.cat(batch), 400
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
    assert max(furthest) <= env.spawn_extent < 0.3
    # and not half the table: an obstacle outside of it must matter
    assert max(furthest) >= 0.75 * env.spawn_extent


def reach(actor, shapes):
    """Distance of the furthest point of a body from the vertical axis through the origin."""
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
    return placed[..., :2].norm(dim=2).max().item()


@pytest.mark.parametrize("task", ["PushCube-v1", "PullCube-v1"])
def test_goal_lies_ahead_of_a_cube_in_a_disc(task):
    env = shared(task, 64)
    obs, _ = env.reset(seed=list(range(64)))
    layout = env.observation_layout
    distance = obs[:, layout.slice("cube_xy")].norm(dim=1)
    assert distance.max() <= env.spawn_radius + 1e-6
    # Uniform in the disc: half of the points lie within radius / sqrt(2).
    assert 0.35 < (distance < env.spawn_radius / math.sqrt(2)).float().mean() < 0.65
    ahead = obs[:, layout.slice("cube_to_goal_xy")]
    assert torch.allclose(ahead, 0.2 * env.direction(), atol=1e-5)


def test_restoring_a_state(floating):
    """The state comes back to the bit, controller targets included, and goes on as before."""
    roam(floating, 4)
    state = copied(floating)
    roam(floating, 6, seed=2)
    expected = copied(floating)
    floating.set_state_dict(rows_of(state, [2, 3]), env_idx=torch.tensor([4, 1]))
    now = floating.get_state_dict()
    assert_same(rows_of(now, [0, 2, 3, 5]), rows_of(expected, [0, 2, 3, 5]))
    assert_same(rows_of(now, [4, 1]), rows_of(state, [2, 3]))
    floating.set_state_dict(state)
    assert_same(copied(floating), state)
    roam(floating, 6, seed=2)
    now = floating.get_state_dict()
    turned, target = (s["controller"]["root"]["target_qpos"][:, 3:] for s in (now, expected))
    assert torch.equal(turned, target)
    # PhysX keeps contact caches of its own, which no state holds. In PushT the hand comes down on
    # the block, whose many solver iterations lean on them.
    tolerance = 1e-3 if floating.task_id == "PushT-v1" else 2e-5
    for kind, columns in (("actors", slice(0, 3)), ("articulations", slice(13, 21))):
        for name, value in now[kind].items():
            close = torch.isclose(value, expected[kind][name], atol=tolerance)[:, columns]
            assert close.all(), name


def test_turning_a_state_turns_observation_and_keeps_the_reward(floating):
    """The layout says how each observed number turns; the simulation state must agree.

    Nothing in the observation depends on how the state came about (contacts, velocities).
    """
    roam(floating, 8)
    seen, state = floating.get_obs().clone(), copied(floating)
    floating.set_state_dict(state)
    obs, zero = floating.get_obs().clone(), torch.zeros(6, 7)
    assert torch.allclose(obs, seen, atol=1e-6)
    reward = floating.get_reward(obs, zero, floating.get_info()).clone()
    for angle, reflect in ELEMENTS:
        there = floating.transform_state(state, angle, reflect)
        floating.set_state_dict(there)
        expected = floating.observation_layout.transform(obs.double(), angle, reflect)
        assert torch.allclose(floating.get_obs().double(), expected, atol=2e-5), (angle, reflect)
        turned = floating.get_reward(obs, zero, floating.get_info())
        assert torch.allclose(turned, reward, atol=1e-5)
        if reflect:  # a reflection followed by a rotation is its own inverse
            back = floating.transform_state(there, angle, reflect)
            map_trees(
                lambda a, b: torch.testing.assert_close(a, b, atol=5e-6, rtol=1e-5), back, state
            )


def test_panda_states_cannot_be_turned():
    env = shared("PickCube-v1", 4, embodiment="panda")
    with pytest.raises(UserError, match="floating"):
        env.transform_state(env.get_state_dict(), 0.5)


@pytest.mark.parametrize(("task", "angle"), [("PushCube-v1", 0.0), ("PullCube-v1", math.pi)])
def test_reward_in_the_stock_direction_is_maniskills(task, angle):
    env = shared(task, reward_mode="dense")
    env.reset(seed=list(range(6)))
    roam(env, 6)
    direction = env.direction()
    angles = angle - torch.atan2(direction[:, 1], direction[:, 0])
    # Turn every environment so that it moves along the stock direction.
    now = env.get_state_dict()
    state = join_trees(
        [rows_of(env.transform_state(now, float(a)), [i]) for i, a in enumerate(angles)]
    )
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


def test_truncation_at_the_limit_and_use_after_the_end():
    env = make("PickCube-v1", num_envs=2)
    env.reset(seed=[0, 1])
    for step in range(env.max_episode_steps):
        _, _, terminated, truncated, _ = env.step(torch.zeros(2, 7))
        assert truncated.tolist() == [step + 1 == env.max_episode_steps] * 2
        assert not terminated.any()
    env.close()
    for use in (lambda: env.step(torch.zeros(2, 7)), lambda: env.reset(seed=[0])):
        with pytest.raises(UserError, match="was closed"):
            use()


def test_feasible_return():
    task = task_class("PickCube-v1")
    assert task.feasible_return(0.9, steps_per_decision=4) == pytest.approx((-40.0, 0.0))
    low, high = task.feasible_return(0.5, steps_per_decision=25, bootstrap_truncation=False)
    assert (low, high) == pytest.approx((-25 * (1 + 0.5), 0.0))
    assert task.feasible_return(1.0, bootstrap_truncation=False)[0] == -50
    for gamma in (1.0, -0.1):
        with pytest.raises(UserError, match="gamma"):
            task.feasible_return(gamma)
