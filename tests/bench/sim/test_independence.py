"""Environments do not influence each other, and the same input gives the same numbers."""

from __future__ import annotations

import gc
from itertools import pairwise

import psutil
import pytest
import torch

from symsteer.bench.sim.trees import rows_of
from tests.bench.sim.scenes import actions, batched, come_down, fresh, rollout

N = 4
MODE = {"control_mode": "pd_ee_delta_pose"}


def packed(env) -> list[bytes]:
    """Everything PhysX holds about each scene's state."""
    return [system.pack() for system in env.scene.px.systems]


def twins(task):
    """Two environments in the midst of the same episodes, and further actions for them."""
    envs = [batched(task, N, number, **MODE) for number in range(2)]
    moves = actions(envs[0], 16)
    for env in envs:
        env.reset(seed=list(range(N)), options={"reconfigure": True})
        rollout(env, moves[:8])
    return *envs, moves[8:]


@pytest.mark.parametrize("task", ["PushCube", "PickCube", "StackCube"])
def test_partial_reset_leaves_others_alone(task):
    """Environments that are not reset keep every bit, then and later."""
    env, twin, moves = twins(task)
    before, scene_before = env.get_state(), packed(env)
    env.reset(seed=[5, 6], options={"env_idx": torch.tensor([1, 3])})
    scene_after = packed(env)
    same = [torch.equal(*rows) for rows in zip(env.get_state(), before, strict=True)]
    assert same == [True, False, True, False]
    assert [scene_after[i] == scene_before[i] for i in range(N)] == same
    after, expected = rollout(env, moves), rollout(twin, moves)
    assert torch.equal(after[:, [0, 2]], expected[:, [0, 2]])


def test_paused_environments_stand_still_and_the_others_do_not_notice():
    env, twin, moves = twins("PushCube")
    before = env.get_state()
    env.pause(torch.tensor([True, False, True, False]))
    after, expected = rollout(env, moves[:4]), rollout(twin, moves[:4])
    assert torch.equal(after[:, [1, 3]], expected[:, [1, 3]])
    assert not torch.equal(after[-1], expected[-1])
    assert torch.equal(env.get_state()[[0, 2]], before[[0, 2]])
    env.pause(torch.zeros(N, dtype=torch.bool))
    after, expected = rollout(env, moves[4:]), rollout(twin, moves[4:])
    assert torch.equal(after[:, [1, 3]], expected[:, [1, 3]])
    assert not torch.equal(env.get_state()[[0, 2]], before[[0, 2]])


def test_contacts_are_read_of_environments_that_moved(monkeypatch):
    env, _, _ = twins("PickCube")
    finger, cube = env.agent.finger1_link, env.cube
    before = env.scene.get_pairwise_contact_forces(finger, cube)
    read, reader = [], env.scene.px._contacts
    monkeypatch.setattr(reader, "_read", lambda system: read.append(system) or [])
    env.pause(torch.tensor([True, False, True, False]))
    env.step(torch.zeros(N, 7))
    assert read == [env.scene.px.systems[i] for i in (1, 3)]
    after = env.scene.get_pairwise_contact_forces(finger, cube)
    assert torch.equal(after[[0, 2]], before[[0, 2]])


def test_partial_set_state_leaves_others_alone():
    env, _, _ = twins("PickCube")
    state, before = env.get_state(), packed(env)
    env.set_state_dict(rows_of(env.get_state_dict(), [0]), env_idx=torch.tensor([2]))
    assert [a == b for a, b in zip(packed(env), before, strict=True)] == [True, True, False, True]
    torch.testing.assert_close(env.get_state()[2], state[0], atol=1e-6, rtol=0)


def test_one_of_many_equals_a_single_one():
    """Environment i of N gives what an environment alone gives, to the last bit."""
    env, _, moves = twins("PickCube")
    alone = batched("PickCube", 1, **MODE)
    env.reset(seed=list(range(N)), options={"reconfigure": True})
    alone.reset(seed=9, options={"reconfigure": True})
    alone.set_state_dict(rows_of(env.get_state_dict(), [2]))
    assert torch.equal(rollout(alone, moves[:, 2:3])[:, 0], rollout(env, moves)[:, 2])


def test_repeats_to_the_last_bit():
    """After earlier episodes with contact, after reconfiguration and in a fresh environment."""
    env, new = batched("PickCube", N, **MODE), fresh("PickCube", N, **MODE)
    moves = actions(env, 12)
    moves[:8, :, 2] = -1  # down onto the table
    traces = []
    for e, options in ((env, {"reconfigure": True}), (env, {}), (new, {})):
        e.reset(seed=list(range(N)), options=options)
        traces.append((e.get_state(), rollout(e, moves)))
    for start, trace in traces[1:]:
        assert torch.equal(start, traces[0][0])
        assert torch.equal(trace, traces[0][1])


def test_reset_forgets_contacts():
    """A reset does not report the grasp of the episode before; others keep theirs."""
    env = batched("PickCube", 3, **MODE)
    env.reset(seed=[1, 2, 3])
    come_down(env)
    close = torch.zeros(3, 7)
    close[:, 6] = -1
    for _ in range(4):
        info = env.step(close)[-1]
    assert info["is_grasped"].all()
    _, info = env.reset(seed=[3], options={"env_idx": torch.tensor([0])})
    assert info["is_grasped"].tolist() == [False, True, True]


def test_memory_stays():
    """Memory does not grow with resets, reconfigurations or discarded environments.

    A leak takes memory in every round, the allocator only in some: the smallest growth counts.
    """
    env, sizes = batched("PickCube", 2), []
    for _ in range(5):
        for seed in range(10):
            env.reset(seed=[seed, seed + 1])
        for _ in range(2):
            env.reset(seed=1, options={"reconfigure": True})
            fresh("PickCube", 2).close()
        gc.collect()
        sizes.append(psutil.Process().memory_info().rss)
    assert min(after - before for before, after in pairwise(sizes[1:])) < 2**18, sizes
