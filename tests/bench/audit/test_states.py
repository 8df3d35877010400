"""Turned states: of the floating gripper about any centre, of the arm by inverse kinematics."""

import math

import pytest
import torch

from symsteer.bench.audit.states import Turner, visit
from symsteer.bench.sim.rotations import planar_matrix, transform_quaternion
from symsteer.bench.sim.trees import map_trees
from symsteer.bench.tasks import make


@pytest.fixture(scope="module", params=["floating", "panda"])
def visited(request):
    env = make("PickCube-v1", num_envs=12, embodiment=request.param)
    yield env, visit(env, 12, 4, seed=0)
    env.close()


def test_visited_states_replay(visited):
    """The stored states and actions lead to the stored next states."""
    env, states = visited
    env.reset(seed=0, options={"reconfigure": True})
    env.set_state_dict(states.state)
    before = env.agent.tcp_pose.p.clone()
    for step in range(4):
        env.step(states.actions[:, step])
        tool = env.agent.tcp_pose.p.clone()
        assert (tool - before).norm(dim=1).mean() > 5e-3
        present = env.get_state_dict()
        after = map_trees(lambda later, k=step: later[:, k], states.path)
        env.set_state_dict(after)
        # Up to the forces of contacts that an episode remembers and a fresh scene does not.
        assert (env.agent.tcp_pose.p - tool).norm(dim=1).median() < 1e-4
        before = tool
        env.set_state_dict(present)


def test_visited_states_differ(visited):
    _, states = visited
    assert 0 < states.moving.float().mean() < 1
    objects = states.state["actors"]["cube"][:, :2]
    assert torch.cdist(objects, objects).fill_diagonal_(1).min() > 1e-4
    assert not states.policy.any()


@pytest.mark.parametrize("reflect", [False, True])
def test_turned_tools_stand_where_they_should(visited, reflect):
    env, states = visited
    centre = torch.tensor([0.03, -0.02])
    angle = 3 * math.pi / 4
    turned, reached = Turner(env).turn(states.state, (angle, reflect), centre)
    assert reached.float().mean() >= 0.9
    env.set_state_dict(states.state)
    tool, cube = env.agent.tcp_pose, env.manipulated.pose
    matrix = planar_matrix(angle, reflect, centre)
    shift = torch.cat([centre, torch.zeros(1)])
    wanted = [(p - shift) @ matrix.T + shift for p in (tool.p, cube.p)]
    axes = transform_quaternion(tool.q, angle, reflect)
    env.set_state_dict(turned)
    tool, cube = env.agent.tcp_pose, env.manipulated.pose
    torch.testing.assert_close(tool.p[reached], wanted[0][reached], atol=3e-5, rtol=0)
    torch.testing.assert_close(cube.p, wanted[1], atol=1e-5, rtol=0)
    dots = (tool.q * axes).sum(dim=1).abs()
    assert dots[reached].min() > 1 - 1e-7


def test_turned_tools_move_as_they_should(visited):
    """The tool's velocity turns too."""
    env, states = visited
    turned, reached = Turner(env).turn(states.state, (math.pi / 2, False), torch.zeros(2))
    paths = []
    for state in (states.state, turned):
        env.set_state_dict(state)
        paths.append(env.agent.tcp.linear_velocity.clone())
    matrix = planar_matrix(math.pi / 2, False, paths[0])
    assert paths[0].norm(dim=1).max() > 0.05
    error = (paths[0] @ matrix.T - paths[1])[reached].norm(dim=1)
    assert error.max() < 2e-3


def test_out_of_reach_is_said(visited):
    env, states = visited
    _, reached = Turner(env).turn(states.state, (math.pi, False), torch.tensor([1.0, 0.0]))
    assert reached.any() == (env.embodiment == "floating")
