"""Tasks that cameras see: clouds of points turn with the scene, and a policy learns from them."""

import math

import numpy as np
import pytest
import sapien
import torch
from mani_skill.utils.structs import Link
from sapien import physx
from sapien.physx import PhysxCollisionShapeConvexMesh
from sapien.render import RenderBodyComponent, RenderShapeTriangleMesh

from symsteer.bench.audit.result import AuditSettings
from symsteer.bench.demos import collect, load
from symsteer.bench.sim.headless import rendering_works
from symsteer.bench.tasks import EMBODIMENTS, make, task_class
from symsteer.bench.tasks.clouds import POINTS, hulls_of, moved, thinned
from symsteer.bench.tasks.experts import Expert
from symsteer.errors import UserError
from symsteer.leaderboard.records import read_record
from tests.bench.tiny_run import execute, tiny_config

needs_vulkan = pytest.mark.skipif(not rendering_works(), reason="needs a Vulkan driver")
SEEN = ["SeenPushCube-v1", "SeenPickCube-v1"]


POINTS_OF_THREE = torch.randn(
    3, 200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64
)


def apart(a, b):
    return torch.cdist(a, b, compute_mode="donot_use_mm_for_euclid_dist")


def test_thinned_points_are_valid_ones_far_from_each_other():
    points = POINTS_OF_THREE
    valid = torch.rand(3, 200, generator=torch.Generator().manual_seed(1)) < 0.5
    chosen = thinned(points, valid, 20)
    for row in range(3):
        there = points[row, valid[row]]
        distances = apart(chosen[row], there)
        assert (distances.min(dim=1).values == 0).all()
        # No other point is farther from all chosen ones than these are from each other.
        between = apart(chosen[row], chosen[row]).fill_diagonal_(torch.inf).min()
        assert distances.min(dim=0).values.max() <= between
        assert chosen[row, 0, :2].norm() == there[:, :2].norm(dim=1).max()


def test_the_choice_turns_with_the_points():
    points, valid = POINTS_OF_THREE, torch.ones(3, 200, dtype=torch.bool)
    c, s = math.cos(0.7), math.sin(0.7)
    turn = torch.tensor([[c, s, 0], [-s, c, 0], [0, 0, 1]], dtype=torch.float64)
    order = torch.randperm(200, generator=torch.Generator().manual_seed(2))
    torch.testing.assert_close(
        thinned(points[:, order] @ turn, valid, 30), thinned(points, valid, 30) @ turn
    )


def test_few_points_occur_several_times_and_none_are_the_origin():
    points, valid = POINTS_OF_THREE, torch.zeros(3, 200, dtype=torch.bool)
    valid[1, 5] = valid[2, 7] = valid[2, 9] = True
    chosen = thinned(points, valid, 4)
    assert torch.equal(chosen[0], torch.zeros(4, 3, dtype=torch.float64))
    assert torch.equal(chosen[1], points[1, [5, 5, 5, 5]])
    assert {tuple(p.tolist()) for p in chosen[2]} == {tuple(p.tolist()) for p in points[2, [7, 9]]}


def test_variants_of_perception_turn_points_too():
    points = POINTS_OF_THREE.float()
    c, s = math.cos(math.radians(10)), math.sin(math.radians(10))
    turned = points @ torch.tensor([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
    shifted = points + torch.tensor([0.02, 0, 0])
    for variant, wanted in (
        ("none", points),
        ("perception_bias", shifted),
        ("camera_rotation", turned),
    ):
        strength = None if variant == "none" else (0.0, 1.0, 1.0)
        env = make("PushCube-v1", num_envs=3, variant=variant, strength=strength)
        env.reset(seed=[3, 4, 5])
        true = env.manipulated.pose
        found = moved(points, true, env.seen(true, "object"))
        assert torch.equal(found[0], points[0])
        torch.testing.assert_close(found[1:], wanted[1:], atol=1e-5, rtol=0)
        env.close()


@pytest.mark.parametrize("task", SEEN)
def test_the_layout_has_no_pose_of_what_is_seen_and_an_audit_needs_an_encoder(task):
    names = [field.name for field in task_class(task).observation_layout.fields]
    assert names[-2:] == ["cloud_xy", "cloud_z"]
    assert not any("cube" in name for name in names)
    assert task_class(task).observation_layout.cloud.columns.shape == (POINTS, 3)
    with pytest.raises(UserError, match="compared after the encoder of a base policy"):
        AuditSettings(task=task, states="expert").check()
    with pytest.raises(UserError, match="no encoder of what is seen has mirror symmetry"):
        AuditSettings(task=task, states="both", group="D4").check()


@pytest.mark.skipif(rendering_works(), reason="there is a Vulkan driver here")
def test_without_a_driver_a_sentence_says_what_is_missing():
    with pytest.raises(UserError, match="Rendering needs a Vulkan driver"):
        make(SEEN[0], num_envs=1)


@pytest.fixture(scope="module", params=SEEN)
def seen(request):
    env = make(request.param, num_envs=2)
    yield env
    env.close()


@needs_vulkan
@pytest.mark.slow
def test_points_lie_on_the_cube(seen):
    obs, _ = seen.reset(seed=[3, 4])
    cloud = seen.cloud()
    to_body = seen.manipulated.pose.inv().to_transformation_matrix()
    local = cloud @ to_body[:, :3, :3].transpose(1, 2) + to_body[:, None, :3, 3]
    # A picture's depth is in millimetres.
    assert (local.abs() - 0.02).clamp_min(0).norm(dim=2).max() < 0.003
    assert (cloud.amax(1) - cloud.amin(1)).min() > 0.02
    assert torch.equal(obs[:, seen.observation_layout.cloud.columns], cloud)


@needs_vulkan
@pytest.mark.slow
def test_the_goal_hides_nothing():
    """Wherever it is drawn, the cube's points stay."""
    env = make("SeenPickCube-v1", num_envs=1)
    env.reset(seed=[3])
    apart, there = env.cloud(), env.cube.pose
    env.goal_site.set_pose(there)
    assert torch.equal(env.cloud(), apart)
    assert not env.goal_site.hidden
    env.close()


@needs_vulkan
@pytest.mark.slow
@pytest.mark.parametrize("embodiment", EMBODIMENTS)
def test_the_robot_hides_what_its_meshes_would_hide_and_films_show_them(embodiment):
    env = make(SEEN[0], num_envs=8, embodiment=embodiment)
    env.reset(seed=range(8))
    expert = Expert(env)
    for _ in range(8):
        env.step(expert.act())
    ids = {"cube": [], "robot": []}
    for number, body in env.segmentation_id_map.items():
        if isinstance(body, Link) or body is env.manipulated:
            ids["robot" if isinstance(body, Link) else "cube"].append(number)
    drawn, capture = [], env.capture_sensor_data
    env.capture_sensor_data = lambda: [drawn.append(triangles(env)), capture()]
    pixels = []
    for _ in range(2):
        label = env.look()[1]
        pixels.append([int(torch.isin(label, torch.tensor(each)).sum()) for each in ids.values()])
        # Afterwards all is as in films.
        assert triangles(env) > 25_000
        env._draw = lambda for_cameras: None
    env.close()
    assert drawn[0] < 5_000
    assert drawn[1] > 25_000
    (cube, robot), (true_cube, true_robot) = pixels
    assert 0.97 * true_cube < cube < 1.01 * true_cube
    assert 0.97 * true_robot < robot < 1.15 * true_robot


def triangles(env):
    """Those that are drawn in the first scene, table and ground included."""
    components = [
        component
        for entity in env.scene.sub_scenes[0].entities
        for component in entity.components
        if isinstance(component, RenderBodyComponent) and component.visibility
    ]
    meshes = [
        s for c in components for s in c.render_shapes if isinstance(s, RenderShapeTriangleMesh)
    ]
    return sum(len(part.triangles) for mesh in meshes for part in mesh.parts)


@needs_vulkan
@pytest.mark.slow
def test_hulls_are_where_the_shapes_are():
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], np.float32)
    shape = PhysxCollisionShapeConvexMesh(corners, [2, 1, 3], physx.get_default_material())
    shape.local_pose = sapien.Pose([1, 2, 3])
    (surface,) = hulls_of([shape]).render_shapes
    assert surface.local_pose.p.tolist() == [1, 2, 3]
    assert surface.parts[0].vertices.max(axis=0).tolist() == [2, 1, 3]


@needs_vulkan
@pytest.mark.slow
def test_what_is_seen_turns_with_the_scene(seen):
    """Exactly under quarter turns, up to a picture's rounding; else up to its pixels."""
    seen.reset(seed=[3, 4])
    state, cloud = seen.get_state_dict(), seen.cloud()
    for angle, bound in ((math.pi / 2, 0.001), (math.pi / 4, 0.008), (0.3, 0.008)):
        seen.set_state_dict(seen.transform_state(state, angle))
        c, s = math.cos(angle), math.sin(angle)
        turned = cloud @ torch.tensor([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
        nearest = apart(seen.cloud(), turned).min(dim=2).values
        assert nearest.mean() < bound


@needs_vulkan
@pytest.mark.slow
def test_variants_of_perception_move_the_cloud():
    (plain, _), (moved, _) = (
        make(SEEN[0], num_envs=1, variant=variant).reset(seed=[5])
        for variant in ("none", "perception_bias:1")
    )
    shift = (moved - plain)[:, task_class(SEEN[0]).observation_layout.cloud.columns]
    torch.testing.assert_close(shift, torch.tensor([0.02, 0, 0]).expand_as(shift))


@needs_vulkan
@pytest.mark.slow
def test_between_decisions_nobody_looks(seen):
    columns = seen.observation_layout.cloud.columns
    first, _ = seen.reset(seed=[3, 4])
    seen.set_state_dict(seen.transform_state(seen.get_state_dict(), 0.5))
    seen.looks = False
    assert torch.equal(seen.get_obs()[:, columns], first[:, columns])
    # At the time limit the critic looks.
    seen._elapsed_steps[1] = seen.max_episode_steps
    due = seen.get_obs()[:, columns]
    assert torch.equal(due[0], first[0, columns])
    assert torch.equal(due[1], seen.cloud()[1])
    seen.looks = True
    assert torch.equal(seen.get_obs()[:, columns], seen.cloud())


@needs_vulkan
@pytest.mark.slow
@pytest.mark.parametrize("task", SEEN)
def test_the_physics_are_those_of_the_flat_task(task):
    actions = torch.rand(12, 2, 7, generator=torch.Generator().manual_seed(0)) * 2 - 1
    paths = []
    for name in (task, task.removeprefix("Seen")):
        env = make(name, num_envs=2)
        env.reset(seed=[3, 4])
        env.looks = False
        paths.append([env.get_state().clone() for action in actions if env.step(action)])
        env.close()
    assert torch.equal(*map(torch.stack, paths))
    assert not torch.equal(paths[0][0], paths[0][-1])


@needs_vulkan
@pytest.mark.slow
def test_a_policy_is_trained_on_clouds_and_steered(tmp_path):
    path = collect(SEEN[0], "floating", 2, "diverse", 0, tmp_path / "demos.h5", num_envs=2)
    demos = load(path, SEEN[0], "floating")
    assert demos.episodes[0][0].shape[1] == demos.observation_layout.dim
    config = tiny_config(task=SEEN[0], env_steps=80, num_envs=2)
    folder = execute(config, tmp_path / "runs")
    record = read_record(folder / "record.json")
    assert record.status == "finished"
    assert record.base_policy.solvable is not None
