"""Environments do not influence each other, and the same input gives the same numbers."""

from __future__ import annotations

import gc
from itertools import pairwise

import psutil
import pytest
import torch

N = 4


def bytes_of(env) -> list[bytes]:
    """Everything PhysX holds about each scene's state."""
    return [system.pack() for system in env.scene.px.systems]


@pytest.mark.parametrize("task", ["PushCube", "PickCube", "StackCube"])
def test_partial_reset_leaves_others_alone(kit, task):
    """Environments that are not reset keep every bit, then and later."""
    env, twin = (kit.batched(task, N, control_mode="pd_ee_delta_pose") for _ in range(2))
    actions = kit.actions(env, 16)
    for e in (env, twin):
        e.reset(seed=list(range(N)))
        kit.rollout(e, actions[:8])
    before, scene_before = kit.flat(env.get_state_dict()), bytes_of(env)
    env.reset(seed=[5, 6], options={"env_idx": torch.tensor([1, 3])})
    scene_after = bytes_of(env)
    for i in (0, 2):
        assert scene_after[i] == scene_before[i]
        assert torch.equal(kit.flat(env.get_state_dict())[i], before[i])
    for i in (1, 3):
        assert not torch.equal(kit.flat(env.get_state_dict())[i], before[i])
    after, expected = kit.rollout(env, actions[8:]), kit.rollout(twin, actions[8:])
    assert torch.equal(after[:, [0, 2]], expected[:, [0, 2]])


def test_paused_environments_stand_still_and_the_others_do_not_notice(kit):
    env, twin = (kit.batched("PushCube", N, control_mode="pd_ee_delta_pose") for _ in range(2))
    actions = kit.actions(env, 16)
    for e in (env, twin):
        e.reset(seed=list(range(N)))
        kit.rollout(e, actions[:8])
    before = kit.flat(env.get_state_dict())
    env.pause(torch.tensor([True, False, True, False]))
    after, expected = kit.rollout(env, actions[8:12]), kit.rollout(twin, actions[8:12])
    assert torch.equal(after[:, [1, 3]], expected[:, [1, 3]])
    assert not torch.equal(after[-1], expected[-1])
    assert torch.equal(kit.flat(env.get_state_dict())[[0, 2]], before[[0, 2]])
    env.pause(torch.zeros(N, dtype=torch.bool))
    after, expected = kit.rollout(env, actions[12:]), kit.rollout(twin, actions[12:])
    assert torch.equal(after[:, [1, 3]], expected[:, [1, 3]])
    assert not torch.equal(kit.flat(env.get_state_dict())[[0, 2]], before[[0, 2]])


def test_partial_set_state_leaves_others_alone(kit):
    """The same for set_state_dict with an index."""
    env = kit.batched("PickCube", N)
    env.reset(seed=list(range(N)))
    kit.rollout(env, kit.actions(env, 5))
    state, before = env.get_state_dict(), bytes_of(env)
    part = kit.rows(state, 0)
    env.set_state_dict(part, env_idx=torch.tensor([2]))
    after = bytes_of(env)
    assert [a == b for a, b in zip(after, before, strict=True)] == [True, True, False, True]
    torch.testing.assert_close(
        kit.flat(env.get_state_dict())[2], kit.flat(state)[0], atol=1e-6, rtol=0
    )


def test_one_of_many_equals_a_single_one(kit):
    """Environment i of N gives what an environment alone gives, to the last bit."""
    env = kit.batched("PickCube", N, control_mode="pd_ee_delta_pose")
    alone = kit.batched("PickCube", 1, control_mode="pd_ee_delta_pose")
    env.reset(seed=list(range(N)))
    alone.reset(seed=9)
    alone.set_state_dict(kit.rows(env.get_state_dict(), 2))
    actions = kit.actions(env, 15)
    together = kit.rollout(env, actions)
    single = kit.rollout(alone, actions[:, 2:3])
    assert torch.equal(single[:, 0], together[:, 2])


def test_repeats_to_the_last_bit(kit):
    """After earlier episodes with contact, after reconfiguration and in a fresh environment."""
    env = kit.batched("PickCube", N, control_mode="pd_ee_delta_pose")
    actions = kit.actions(env, 12)
    actions[:8, :, 2] = -1  # down onto the table
    env.reset(seed=list(range(N)))
    start = kit.flat(env.get_state_dict())
    first = kit.rollout(env, actions)

    env.reset(seed=list(range(N)))
    assert torch.equal(kit.flat(env.get_state_dict()), start)
    assert torch.equal(kit.rollout(env, actions), first)

    env.reset(seed=list(range(N)), options={"reconfigure": True})
    assert torch.equal(kit.rollout(env, actions), first)

    fresh = kit.batched("PickCube", N, control_mode="pd_ee_delta_pose")
    fresh.reset(seed=list(range(N)))
    assert torch.equal(kit.rollout(fresh, actions), first)


def test_reset_forgets_contacts(kit):
    """A reset does not report the grasp of the episode before; others keep theirs."""
    env = kit.batched("PickCube", 2, control_mode="pd_ee_delta_pose")
    env.reset(seed=[1, 2])
    kit.grasp_pose(env)
    close = torch.zeros(2, 7)
    close[:, 6] = -1
    for _ in range(4):
        _, _, _, _, info = env.step(close)
    assert info["is_grasped"].all()
    _, info = env.reset(seed=[3], options={"env_idx": torch.tensor([0])})
    assert info["is_grasped"].tolist() == [False, True]


def test_memory_stays(kit):
    """Memory does not grow with resets, reconfigurations or discarded environments.

    A leak takes memory in every round, the allocator only in some: the smallest growth counts.
    """
    env = kit.batched("PickCube", 2)

    def bytes_after_use() -> int:
        for seed in range(10):
            env.reset(seed=[seed, seed + 1])
        for _ in range(2):
            env.reset(seed=1, options={"reconfigure": True})
            kit.batched("PickCube", 2).close()
        gc.collect()
        return psutil.Process().memory_info().rss

    bytes_after_use()
    rounds = [bytes_after_use() for _ in range(5)]
    assert min(after - before for before, after in pairwise(rounds)) < 2**18, rounds
