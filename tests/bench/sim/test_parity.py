"""The batched scenes agree with ManiSkill's own CPU simulation."""

from __future__ import annotations

import pytest
import torch

from tests.bench.sim.conftest import Kit

STEPS = 20


@pytest.mark.parametrize("task", Kit.tasks)
def test_follows_stock(kit, task):
    """Same state, same joint-space actions: states within 1e-5 over 20 steps, same outcome."""
    env, stock = kit.batched(task, 3), kit.stock(task)
    env.reset(seed=[1, 2, 3])
    stock.reset(seed=4)
    i = 1
    stock.set_state_dict(kit.rows(env.get_state_dict(), i))
    start = kit.flat(env.get_state_dict())[i]
    actions = kit.actions(env, STEPS)
    if task == "PushT":
        # Its stick starts millimetres above the table. Lift it: an impact magnifies a difference
        # of 1e-7 to 1e-3 in a velocity.
        actions[..., 1] = -actions[..., 1].abs()
    for action in actions:
        obs, reward, terminated, _, info = env.step(action)
        stock_obs, stock_reward, stock_terminated, _, stock_info = stock.step(action[i : i + 1])
        state, stock_state = kit.flat(env.get_state_dict()), kit.flat(stock.get_state_dict())
        torch.testing.assert_close(state[i], stock_state[0], atol=1e-5, rtol=0)
        torch.testing.assert_close(obs[i], stock_obs[0], atol=1e-5, rtol=0)
        torch.testing.assert_close(reward[i], stock_reward[0], atol=1e-5, rtol=0)
        assert terminated[i] == stock_terminated[0]
        assert set(info) == set(stock_info)
        for name, value in stock_info.items():
            assert info[name][i] == value[0], name
    assert (state[i] - start).abs().max() > 0.1  # the robot did move


def test_success_equals_stock(kit):
    """Both report success in the same state, and sleeping bodies do not differ."""
    env, stock = kit.batched("PickCube", 2), kit.stock("PickCube")
    env.reset(seed=[1, 2])
    stock.reset(seed=3)
    state = env.get_state_dict()
    state["actors"]["cube"][1, :3] = torch.tensor([0.3, 0.3, 0.02])
    state["actors"]["goal_site"][1, :3] = torch.tensor([0.3, 0.3, 0.02])
    env.set_state_dict(state)
    stock.set_state_dict(kit.rows(state, 1))
    still = torch.zeros(2, env.single_action_space.shape[0])
    for _ in range(STEPS):
        _, reward, _, _, info = env.step(still)
        _, stock_reward, _, _, stock_info = stock.step(still[:1])
        assert info["success"][1] == stock_info["success"][0]
        torch.testing.assert_close(reward[1], stock_reward[0], atol=1e-5, rtol=0)
    assert info["success"].tolist() == [False, True]


def test_held_robot_stays_awake(kit):
    """Holding one target for seconds keeps the robot awake, as stock ManiSkill does."""
    env = kit.batched("PickCube", 2, control_mode="pd_joint_pos")
    stock = kit.stock("PickCube", control_mode="pd_joint_pos")
    env.reset(seed=[1, 2])
    stock.reset(seed=3)
    stock.set_state_dict(kit.rows(env.get_state_dict(), 1))
    hold = torch.cat([env.agent.robot.get_qpos()[:, :7], torch.ones(2, 1)], dim=1)
    for _ in range(60):
        env.step(hold)
        stock.step(hold[1:])
    for e in (env, stock):
        assert not any(robot.links[0].sleeping for robot in e.agent.robot._objs)
    state, stock_state = kit.flat(env.get_state_dict()), kit.flat(stock.get_state_dict())
    torch.testing.assert_close(state[1], stock_state[0], atol=1e-6, rtol=0)


def test_contact_impulses_equal_stock(kit):
    """Pair and body queries during a grasp report what stock ManiSkill computes."""
    env = kit.batched("PickCube", 3, control_mode="pd_ee_delta_pose")
    env.reset(seed=[1, 2, 3])
    kit.grasp_pose(env)
    before_contact = env.get_state_dict()
    qpos = env.agent.robot.get_qpos().clone()
    env = kit.batched("PickCube", 3, control_mode="pd_joint_pos")
    stock = kit.stock("PickCube", control_mode="pd_joint_pos")
    env.set_state_dict(before_contact)
    i = 2
    stock.set_state_dict(kit.rows(before_contact, i))
    close = torch.cat([qpos[:, :7], -torch.ones(3, 1)], dim=1)
    largest = 0.0
    for _ in range(6):
        _, _, _, _, info = env.step(close)
        _, _, _, _, stock_info = stock.step(close[i : i + 1])
        for finger in ("finger1_link", "finger2_link"):
            ours, theirs = getattr(env.agent, finger), getattr(stock.agent, finger)
            force = env.scene.get_pairwise_contact_forces(ours, env.cube)
            stock_force = stock.scene.get_pairwise_contact_forces(theirs, stock.cube)
            torch.testing.assert_close(force[i], stock_force[0].float(), atol=0.2, rtol=0.02)
            reverse = env.scene.get_pairwise_contact_forces(env.cube, ours)
            torch.testing.assert_close(reverse, -force)
            net, stock_net = ours.get_net_contact_forces(), theirs.get_net_contact_forces()
            torch.testing.assert_close(net[i], stock_net[0].float(), atol=0.2, rtol=0.02)
            largest = max(largest, force[i].norm().item())
        names = [env.agent.finger1_link.name, env.agent.finger2_link.name]
        both = env.agent.robot.get_net_contact_impulses(names)
        torch.testing.assert_close(both[:, 1], env.agent.finger2_link.get_net_contact_impulses())
        assert info["is_grasped"][i] == stock_info["is_grasped"][0]
    assert largest > 5  # newtons: there was something to compare
    assert info["is_grasped"].all()


def test_stock_is_left_alone(kit):
    """A stock environment gives the same numbers with and without ours in the process."""
    stock = kit.stock("PickCube", control_mode="pd_ee_delta_pose")
    stock.reset(seed=1)
    actions = kit.actions(stock, 5)
    alone = kit.rollout(stock, actions)
    env = kit.batched("PickCube", 2, control_mode="pd_ee_delta_pose")
    env.step(kit.actions(env, 1)[0])
    again = kit.stock("PickCube", control_mode="pd_ee_delta_pose")
    again.reset(seed=1)
    assert not again.gpu_sim_enabled
    assert not again.agent.controller.controllers["arm"].kinematics.use_gpu_ik
    torch.testing.assert_close(kit.rollout(again, actions), alone, atol=0, rtol=0)


def test_pushed_object_follows_stock(kit):
    """PushT's stick pushes the T. In contact, two stock runs from states that differ by 1e-7 also
    differ by up to 1e-3."""
    env, stock = kit.batched("PushT", 2), kit.stock("PushT")
    env.reset(seed=[1, 2])
    stock.reset(seed=4)
    state = env.get_state_dict()
    body = state["actors"]["Tee"]
    # Beside the tool, which the first joint then sweeps towards it.
    body[1, :2] = env.agent.tcp.pose.p[1, :2] + torch.tensor([0.0, 0.08])
    start = body[1, :2].clone()
    env.set_state_dict(state)
    stock.set_state_dict(kit.rows(state, 1))
    sweep = torch.zeros(2, env.single_action_space.shape[0])
    sweep[:, 0] = 0.4
    for _ in range(12):
        _, reward, _, _, _ = env.step(sweep)
        _, stock_reward, _, _, _ = stock.step(sweep[1:])
    moved = env.get_state_dict()["actors"]["Tee"][1, :7]
    assert (moved[:2] - start).norm() > 0.02
    torch.testing.assert_close(
        moved, stock.get_state_dict()["actors"]["Tee"][0, :7], atol=1e-3, rtol=0
    )
    torch.testing.assert_close(reward[1], stock_reward[0], atol=1e-2, rtol=0)
