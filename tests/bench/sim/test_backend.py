"""The buffers, calls and hooks of the batched physics system."""

from __future__ import annotations

import numpy as np
import pytest
import sapien
import torch
from mani_skill.envs.sapien_env import BaseEnv
from mani_skill.envs.tasks.tabletop.pick_cube import PickCubeEnv
from mani_skill.utils.building.ground import build_ground
from mani_skill.utils.structs.actor import Actor

from symsteer.bench.sim.kinematics import SerialChain
from symsteer.bench.sim.parallel import create
from tests.bench.sim.scenes import batched


class Playground(BaseEnv):
    """Boxes of every kind on a ground plane, and a robot whose root is free to fall."""

    SUPPORTED_ROBOTS = ("none",)

    def __init__(self, *args, **kwargs):
        super().__init__(*args, robot_uids="none", **kwargs)

    def _load_scene(self, options):
        build_ground(self.scene, altitude=0)
        self.boxes: dict[str, Actor] = {}
        for x, kind in enumerate(("dynamic", "kinematic", "static")):
            builder = self.scene.create_actor_builder()
            builder.add_box_collision(half_size=[0.1, 0.1, 0.1])
            builder.initial_pose = sapien.Pose([x, 0, 1])
            self.boxes[kind] = getattr(builder, f"build_{kind}")(name=kind)
        marker = self.scene.create_actor_builder()
        marker.initial_pose = sapien.Pose([0, 3, 1])
        self.marker = marker.build_kinematic(name="marker")
        self.chain = self._build_chain()

    def _build_chain(self):
        builder = self.scene.create_articulation_builder()
        builder.initial_pose = sapien.Pose([0, 2, 1])
        root = builder.create_link_builder()
        root.set_name("root")
        root.add_box_collision(half_size=[0.1, 0.1, 0.1])
        link = builder.create_link_builder(root)
        link.set_name("arm")
        link.add_box_collision(half_size=[0.1, 0.1, 0.1])
        link.set_joint_name("hinge")
        link.set_joint_properties(
            "revolute", [[-1, 1]], sapien.Pose([0.2, 0, 0]), sapien.Pose([-0.2, 0, 0])
        )
        return builder.build(name="chain", fix_root_link=False)

    def _get_obs_agent(self):
        return {}

    def get_state_dict(self):
        return self.scene.get_sim_state()

    def evaluate(self):
        return {}

    def compute_dense_reward(self, obs, action, info):
        return torch.zeros(self.num_envs)

    compute_normalized_dense_reward = compute_dense_reward


@pytest.fixture(scope="module")
def built():
    env = create(Playground, 3, obs_mode="state_dict")
    yield env
    env.close()


@pytest.fixture
def playground(built):
    built.reset(seed=[1, 2, 3], options={"reconfigure": True})
    return built


def write(env) -> None:
    env.scene._gpu_apply_all()
    env.scene._gpu_fetch_all()


def test_every_scene_has_a_ground(playground):
    """On CUDA all scenes share one plane; here each needs its own."""
    for _ in range(40):
        playground.step(None)
    heights = playground.boxes["dynamic"].pose.p[:, 2]
    torch.testing.assert_close(heights, torch.full((3,), 0.1), atol=5e-3, rtol=0)
    kinematic = playground.boxes["kinematic"].pose.p
    torch.testing.assert_close(kinematic, torch.tensor([[1.0, 0, 1]]).repeat(3, 1))
    assert playground.boxes["static"].pose.p[:, 2].tolist() == [1, 1, 1]


def test_free_root(playground):
    """Root pose and velocity of an articulation that is not fixed: set, step, read."""
    chain = playground.chain
    pose = torch.tensor([[0.0, 2, 3, 1, 0, 0, 0]]).repeat(3, 1)
    pose[:, 2] += torch.arange(3)
    chain.set_root_pose(pose)
    chain.set_root_linear_velocity(torch.tensor([[0.5, 0, 0]] * 3))
    write(playground)
    torch.testing.assert_close(chain.root.pose.raw_pose, pose)
    arm = chain.links_map["arm"]
    torch.testing.assert_close(arm.pose.p, pose[:, :3] + torch.tensor([0.4, 0, 0]))
    playground.step(None)
    moved = chain.root.pose.p - pose[:, :3]
    torch.testing.assert_close(moved[:, 0], torch.full((3,), 0.025), atol=1e-4, rtol=0)
    assert (moved[:, 2] < 0).all()
    torch.testing.assert_close(
        chain.root.linear_velocity[:, 2], torch.full((3,), -9.81 * 0.05), atol=1e-2, rtol=0
    )
    torch.testing.assert_close(arm.linear_velocity[:, 0], torch.full((3,), 0.5), atol=1e-2, rtol=0)


def test_buffers_agree_with_sapien(playground):
    """Every row equals the values of SAPIEN's own objects."""
    for _ in range(7):
        playground.step(None)
    box, chain = playground.boxes["dynamic"], playground.chain
    rows = playground.scene.px.cuda_rigid_body_data.torch()[box._body_data_index]
    for i in range(3):
        body, articulation = box._bodies[i], chain._objs[i]
        expected = [*body.entity.pose.p, *body.entity.pose.q]
        expected += [*body.linear_velocity, *body.angular_velocity]
        assert rows[i].tolist() == [float(x) for x in expected]
        assert chain.qpos[i].tolist() == articulation.qpos.tolist()
        assert chain.qvel[i].tolist() == articulation.qvel.tolist()


def test_apply_writes_joints_and_targets(playground):
    """Joint position, velocity, force and drive targets reach SAPIEN's objects."""
    chain, px = playground.chain, playground.scene.px
    chain.set_qpos(torch.tensor([[0.1], [0.2], [0.3]]))
    chain.set_qvel(torch.tensor([[1.0], [2], [3]]))
    chain.set_qf(torch.tensor([[4.0], [5], [6]]))
    chain.set_joint_drive_targets(torch.tensor([[0.5], [0.6], [0.7]]), chain.active_joints)
    write(playground)
    px.gpu_apply_articulation_target_position()
    for i, articulation in enumerate(chain._objs):
        np.testing.assert_allclose(articulation.qpos, [0.1 + 0.1 * i], rtol=1e-6)
        np.testing.assert_allclose(articulation.qvel, [1 + i], rtol=1e-6)
        np.testing.assert_allclose(articulation.qf, [4 + i], rtol=1e-6)
        np.testing.assert_allclose(articulation.active_joints[0].drive_target, [0.5 + 0.1 * i])
    write(playground)
    torch.testing.assert_close(chain.drive_targets, torch.tensor([[0.5], [0.6], [0.7]]))


def test_force_acts_once(playground):
    """A force of m g for one substep changes the velocity by g dt, in one scene only."""
    box = playground.boxes["dynamic"]
    force = torch.zeros(3, 3)
    force[1, 0] = box.mass[1] * 9.81
    box.apply_force(force)
    dt = playground.scene.timestep
    for expected in (9.81 * dt, 9.81 * dt):
        playground.scene.step()
        playground.scene._gpu_fetch_all()
        velocity = box.linear_velocity[:, 0]
        torch.testing.assert_close(velocity, torch.tensor([0, expected, 0]), atol=1e-3, rtol=0)


def test_held_force_equals_one_set_between_substeps(playground):
    """Equal to the bit to a hook that pushes before each substep."""
    force = torch.tensor([[1.0, 2, 0], [0, 0, 0], [-3, 0, 1]])

    class Pushed(Playground):
        def _before_simulation_step(self):
            self.boxes["dynamic"].apply_force(force)

    pushed = create(Pushed, 3, obs_mode="state_dict")
    for env in (pushed, playground):
        env.reset(seed=[1, 2, 3])
    playground.hold_force(playground.boxes["dynamic"], force)
    for _ in range(12):
        pushed.step(None)
        playground.step(None)
        expected = pushed.boxes["dynamic"].pose.raw_pose
        assert torch.equal(playground.boxes["dynamic"].pose.raw_pose, expected)
    pushed.close()
    box = playground.boxes["dynamic"]
    playground.hold_force(box, torch.zeros(3, 3))
    speed = box.linear_velocity[:, 0].clone()
    playground.step(None)
    torch.testing.assert_close(box.linear_velocity[:, 0], speed, atol=0.1, rtol=0)


def test_hidden_object_returns(playground):
    """Hiding moves an object away and showing brings it back, to the bit, without physics.

    A fetch overwrites a buffer that was written but not applied, as on CUDA.
    """
    marker, box = playground.marker, playground.boxes["dynamic"]
    before, still = marker.pose.raw_pose.clone(), box.pose.raw_pose.clone()
    marker.hide_visual()
    assert marker._objs[0].pose.p[0] > 1e4
    assert torch.equal(marker.pose.raw_pose, before)
    marker.show_visual()
    assert marker._objs[0].pose.p.tolist() == before[0, :3].tolist()
    box.set_pose(sapien.Pose([5, 5, 5]))
    playground.scene._gpu_fetch_all()
    assert torch.equal(box.pose.raw_pose, still)


class Hooked(PickCubeEnv):
    """Looks at SAPIEN's own objects between substeps."""

    def __init__(self, *args, **kwargs):
        self.heights = []
        super().__init__(*args, **kwargs)

    def _after_simulation_step(self):
        self.heights.append(self.cube._bodies[0].entity.pose.p[2])


def test_hooks_see_every_substep():
    """If code runs between substeps, they are not deferred; results are the same."""
    lifted = torch.tensor([[0.0, 0, 0.5, 1, 0, 0, 0]]).repeat(2, 1)
    finals, heights = [], []
    for cls in (Hooked, PickCubeEnv):
        env = create(cls, 2, control_mode="pd_joint_delta_pos")
        env.reset(seed=[1, 2])
        env.cube.set_pose(lifted)
        write(env)
        heights.append(len(getattr(env, "heights", [])))
        env.step(torch.zeros(2, 8))
        finals.append(env.get_state())
        if cls is Hooked:
            fall = env.heights[heights[0] :]
            assert len(fall) == 5
            assert all(np.diff(fall) < 0)
    assert torch.equal(*finals)


def test_jacobian_equals_pytorch_kinematics():
    """Our batched Jacobian is the one that ManiSkill's solver would have computed."""
    env = batched("PickCube", 3, control_mode="pd_ee_delta_pose")
    chain = env.agent.controller.controllers["arm"].kinematics.pk_chain
    assert isinstance(chain, SerialChain)
    q = torch.randn(32, 7, generator=torch.Generator().manual_seed(0))
    expected = chain.chain.jacobian(q)
    torch.testing.assert_close(chain.jacobian(q), expected, atol=2e-6, rtol=0)
    single = torch.cat([chain.jacobian(q[i : i + 1]) for i in range(32)])
    assert torch.equal(single, chain.jacobian(q))
