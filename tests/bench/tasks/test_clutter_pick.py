"""ClutterPick: neighbours that block every grasp, a set whose order is not seen."""

import pytest
import torch

from symsteer.bench.sim.rotations import quaternion_to_matrix
from symsteer.bench.sim.trees import map_trees
from symsteer.bench.tasks import make
from symsteer.bench.tasks.clutter_pick import seen_around
from symsteer.bench.tasks.experts import Expert
from symsteer.bench.tasks.pick_cube import PickCube
from symsteer.policies.geometry import Field, Layout
from tests.bench.shared import roam, shared

COUNT = 32
CORNERS = torch.tensor([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])


@pytest.fixture
def env():
    env = shared("ClutterPick-v1", COUNT)
    env.reset(seed=list(range(COUNT)))
    return env


def solved(env, intent):
    """Which episodes an expert with this intent solves."""
    env.reset(seed=list(range(100, 100 + COUNT)))
    env.intent = intent
    expert, done = Expert(env), torch.zeros(COUNT, dtype=torch.bool)
    for _ in range(env.max_episode_steps):
        done |= env.step(expert.act())[-1]["success"]
    del env.intent
    return done.float().mean()


@pytest.mark.long
def test_the_cube_cannot_be_grasped_before_neighbours_are_pushed(env):
    assert (env.blocked()[1] != 0).any(dim=2).all()
    assert solved(env, lambda offset: PickCube.intent(env, offset)) <= 0.2
    assert solved(env, env.intent) >= 0.9


def test_the_expert_pushes_neighbours_and_leaves_the_cube_alone(env):
    places = torch.stack([b.pose.p for b in [env.cube, *env.neighbours]]).clone()
    expert = Expert(env)
    pushed = torch.zeros(COUNT)
    for _ in range(env.max_episode_steps):
        env.step(expert.act())
        moved = (torch.stack([b.pose.p for b in [env.cube, *env.neighbours]]) - places).norm(dim=2)
        down = env.cube.pose.p[:, 2] < 0.021
        assert (moved[0, down] < 0.03).all()
        pushed = torch.where(down, moved[1:].amax(dim=0), pushed)
    assert (pushed > 0.005).all()


def test_cubes_do_not_overlap_at_a_reset(env):
    """Of two squares that are apart, a side of one of them separates them."""
    bodies = [env.cube, *env.neighbours]
    axes = [quaternion_to_matrix(b.pose.q)[:, :2, :2] for b in bodies]
    places = [b.pose.p[:, None, :2] for b in bodies]
    half = env.cube_half_size
    corners = [p + half * CORNERS @ a.mT for p, a in zip(places, axes, strict=True)]
    for i in range(len(bodies)):
        for j in range(i):
            gaps = []
            for frame in (axes[i], axes[j]):
                one, other = corners[i] @ frame, corners[j] @ frame
                gaps += [other.amin(1) - one.amax(1), one.amin(1) - other.amax(1)]
            gap = torch.cat(gaps, dim=1).amax(dim=1)
            assert gap.min() >= env.gaps[0] - 1e-5
            if j == 0:
                assert gap.max() <= env.gaps[1] + 1e-5


def test_the_order_of_neighbours_is_not_seen(env):
    roam(env, 10)
    seen, state = env.get_obs().clone(), map_trees(torch.clone, env.get_state_dict())
    names = [body.name for body in env.neighbours]
    for order in ([1, 0, 2], [1, 2, 0]):
        actors = dict(state["actors"])
        for name, i in zip(names, order, strict=True):
            actors[name] = state["actors"][names[i]]
        env.set_state_dict({**state, "actors": actors})
        assert torch.allclose(env.get_obs(), seen, atol=1e-6)
    state["actors"][names[0]][:, 0] += 0.01
    env.set_state_dict(state)
    assert ((env.get_obs() - seen).abs().amax(dim=1) > 0.05).all()


def test_what_is_seen_of_a_set_turns_with_it_and_has_no_jumps():
    layout = Layout([Field(str(k), k, 3) for k in range(5)])
    generator = torch.Generator().manual_seed(0)
    at, step = torch.randn(2, 200, 4, 2, dtype=torch.float64, generator=generator)
    at = 0.05 * at
    at[0, 0] = 0.0  # right above a neighbour

    def seen(points):
        return torch.cat(seen_around(points, 0.03, 4), dim=1)

    plane = Layout([Field("xy", 1)])
    for element in ((0.7, False), (-2.0, True)):
        turned = seen(plane.transform(at, *element))
        assert torch.allclose(turned, layout.transform(seen(at), *element), atol=1e-12)
    # A hat's slope is 1 / spacing, and a wave of frequency 4 adds at most four times as much.
    moved = seen(at + 1e-6 * step / step.norm(dim=2, keepdim=True)) - seen(at)
    assert moved.abs().max() < 4 * 5 / 0.03 * 1e-6
    far = torch.full((1, 4, 2), 1.0)
    assert seen(far).abs().max() == 0


@pytest.fixture(scope="module")
def unbroken():
    return played()


def played(**options):
    """What is seen while the expert plays, in environments of their own."""
    env = make("ClutterPick-v1", num_envs=2, **options)
    env.reset(seed=[3, 4])
    expert = Expert(env)
    seen = [env.step(expert.act())[0].clone() for _ in range(20)]
    env.close()
    return torch.stack(seen, dim=1)


@pytest.mark.parametrize("variant", ["perception_bias", "gravity_tilt", "wind", "action_gain"])
def test_strength_0_is_the_unbroken_task_to_the_bit(variant, unbroken):
    mixed = played(variant=variant, strength=(0.0, 1.0))
    assert torch.equal(mixed[0], unbroken[0])
    assert not torch.allclose(mixed[1], unbroken[1], atol=1e-3)


def test_biased_cameras_move_the_neighbours_with_the_cube():
    env = make("ClutterPick-v1", num_envs=2, variant="perception_bias:1")
    whole = shared("ClutterPick-v1", 2)
    biased, true = (e.reset(seed=[3, 4])[0] for e in (env, whole))
    layout = env.observation_layout
    for k in range(5):
        part = layout.slice(f"around_cube_{k}")
        assert torch.allclose(biased[:, part], true[:, part], atol=1e-5)
    part = layout.slice("around_tcp_1")
    assert (biased[:, part] - true[:, part]).abs().max() > 0.1
    env.close()
