"""The batched scenes agree with ManiSkill's own CPU simulation."""

from __future__ import annotations

import pytest
import torch

from symsteer.bench.sim.trees import rows_of
from tests.bench.sim.scenes import TASKS, actions, batched, come_down, rollout, stock

STEPS = 20
PUSHED = {"atol": 1e-3, "rtol": 0}
"""In contact, two stock runs from states that differ by 1e-7 also differ by up to this."""


def close(ours, theirs, **tolerance):
    torch.testing.assert_close(ours, theirs, **{"atol": 1e-5, "rtol": 0, **tolerance})


def pair(task, num_envs, i=1, **settings):
    """Ours and stock, both in the state of our environment ``i``."""
    env, one = batched(task, num_envs, **settings), stock(task, **settings)
    env.reset(seed=list(range(1, num_envs + 1)), options={"reconfigure": True})
    one.reset(seed=4)
    one.set_state_dict(rows_of(env.get_state_dict(), slice(i, i + 1)))
    return env, one


@pytest.mark.parametrize("task", TASKS)
def test_follows_stock(task):
    """Same state, same joint-space actions: states within 1e-5 over 20 steps, same outcome."""
    env, one = pair(task, 3)
    i, start, moves = 1, env.get_state()[1], actions(env, STEPS)
    if task == "PushT":
        # Its stick starts millimetres above the table. Lift it: an impact magnifies a difference
        # of 1e-7 to 1e-3 in a velocity.
        moves[..., 1] = -moves[..., 1].abs()
    for action in moves:
        obs, reward, terminated, _, info = env.step(action)
        stock_obs, stock_reward, stock_terminated, _, stock_info = one.step(action[i : i + 1])
        close(env.get_state()[i], one.get_state()[0])
        close(obs[i], stock_obs[0])
        close(reward[i], stock_reward[0])
        assert terminated[i] == stock_terminated[0]
        assert set(info) == set(stock_info)
        for name, value in stock_info.items():
            assert info[name][i] == value[0], name
    assert (env.get_state()[i] - start).abs().max() > 0.1  # the robot did move


def test_success_equals_stock_and_a_held_robot_stays_awake():
    """Also in the same place for seconds; sleeping bodies do not differ."""
    env, one = pair("PickCube", 3, control_mode="pd_joint_pos")
    state = env.get_state_dict()
    for name in ("cube", "goal_site"):
        state["actors"][name][1, :3] = torch.tensor([0.3, 0.3, 0.02])
    env.set_state_dict(state)
    one.set_state_dict(rows_of(state, slice(1, 2)))
    hold = torch.cat([env.agent.robot.get_qpos()[:, :7], torch.ones(3, 1)], dim=1)
    for _ in range(60):
        _, reward, _, _, info = env.step(hold)
        _, stock_reward, _, _, stock_info = one.step(hold[1:2])
        assert info["success"][1] == stock_info["success"][0]
        close(reward[1], stock_reward[0])
    assert info["success"].tolist() == [False, True, False]
    for e in (env, one):
        assert not any(robot.links[0].sleeping for robot in e.agent.robot._objs)
    close(env.get_state()[1], one.get_state()[0], atol=1e-6)


def test_contact_impulses_equal_stock():
    """Pair and body queries during a grasp report what stock ManiSkill computes."""
    env = batched("PickCube", 3, control_mode="pd_ee_delta_pose")
    env.reset(seed=[1, 2, 3])
    come_down(env)
    before_contact, qpos = env.get_state_dict(), env.agent.robot.get_qpos().clone()
    i = 2
    env, one = pair("PickCube", 3, control_mode="pd_joint_pos")
    env.set_state_dict(before_contact)
    one.set_state_dict(rows_of(before_contact, slice(i, i + 1)))
    grasp = torch.cat([qpos[:, :7], -torch.ones(3, 1)], dim=1)
    largest = 0.0
    for _ in range(6):
        info = env.step(grasp)[-1]
        stock_info = one.step(grasp[i : i + 1])[-1]
        for finger in ("finger1_link", "finger2_link"):
            ours, theirs = getattr(env.agent, finger), getattr(one.agent, finger)
            force = env.scene.get_pairwise_contact_forces(ours, env.cube)
            stock_force = one.scene.get_pairwise_contact_forces(theirs, one.cube)
            close(force[i], stock_force[0].float(), atol=0.2, rtol=0.02)
            close(env.scene.get_pairwise_contact_forces(env.cube, ours), -force)
            net, stock_net = ours.get_net_contact_forces(), theirs.get_net_contact_forces()
            close(net[i], stock_net[0].float(), atol=0.2, rtol=0.02)
            largest = max(largest, force[i].norm().item())
        names = [env.agent.finger1_link.name, env.agent.finger2_link.name]
        both = env.agent.robot.get_net_contact_impulses(names)
        close(both[:, 1], env.agent.finger2_link.get_net_contact_impulses())
        assert info["is_grasped"][i] == stock_info["is_grasped"][0]
    assert largest > 5  # newtons: there was something to compare
    assert info["is_grasped"].all()


def test_stock_is_left_alone():
    """A stock environment gives the same numbers with and without ours in the process."""
    settings = {"control_mode": "pd_ee_delta_pose"}
    one = stock("PickCube", **settings)
    one.reset(seed=1)
    moves = actions(one, 5)
    alone = rollout(one, moves)
    env = batched("PickCube", 3, **settings)
    env.step(actions(env, 1)[0])
    again = stock("PickCube", **settings)
    again.reset(seed=1)
    assert not again.gpu_sim_enabled
    assert not again.agent.controller.controllers["arm"].kinematics.use_gpu_ik
    assert torch.equal(rollout(again, moves), alone)


def test_pushed_object_follows_stock():
    """PushT's stick pushes the T."""
    env, one = pair("PushT", 3)
    state = env.get_state_dict()
    body = state["actors"]["Tee"]
    # Beside the tool, which the first joint then sweeps towards it.
    body[1, :2] = env.agent.tcp.pose.p[1, :2] + torch.tensor([0.0, 0.08])
    start = body[1, :2].clone()
    env.set_state_dict(state)
    one.set_state_dict(rows_of(state, slice(1, 2)))
    sweep = torch.zeros(3, env.single_action_space.shape[0])
    sweep[:, 0] = 0.4
    for _ in range(12):
        reward, stock_reward = env.step(sweep)[1], one.step(sweep[1:2])[1]
    moved, theirs = (e.get_state_dict()["actors"]["Tee"][:, :7] for e in (env, one))
    assert (moved[1, :2] - start).norm() > 0.02
    close(moved[1], theirs[0], **PUSHED)
    close(reward[1], stock_reward[0], atol=1e-2)
