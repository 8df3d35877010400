"""The ring of transitions."""

import pytest
import torch

from symsteer.agents.replay import ReplayBuffer
from symsteer.errors import UserError


def numbered(start, count):
    n = torch.arange(start, start + count, dtype=torch.float32)
    return n[:, None].repeat(1, 2), n[:, None, None].repeat(1, 3, 2), n, n[:, None].repeat(1, 2), n


def held(buffer):
    return sorted(buffer.sample(2000).reward.unique().int().tolist())


def test_wraps_around_and_forgets_the_oldest():
    buffer = ReplayBuffer(10, 2, 3, 2)
    buffer.add(*numbered(0, 4))
    assert (len(buffer), held(buffer)) == (4, [0, 1, 2, 3])
    buffer.add(*numbered(4, 4))
    buffer.add(*numbered(8, 4))  # crosses the end
    assert (len(buffer), held(buffer)) == (10, list(range(2, 12)))
    buffer.add(*numbered(12, 10))
    assert held(buffer) == list(range(12, 22))


def test_rows_stay_together():
    buffer = ReplayBuffer(7, 2, 3, 2)
    for start in range(0, 20, 4):
        buffer.add(*numbered(start, 4))
    batch = buffer.sample(100)
    for tensor in batch:
        assert torch.equal(tensor.flatten(1).mean(1) if tensor.ndim > 1 else tensor, batch.reward)
    assert batch.noise.shape == (100, 3, 2)


def test_keeps_copies():
    buffer = ReplayBuffer(4, 2, 3, 2)
    rows = numbered(1, 2)
    buffer.add(*rows)
    rows[0].zero_()
    assert buffer.sample(50).obs.min() >= 1


def test_sampling_is_seeded_and_continues_after_loading():
    def filled(seed):
        buffer = ReplayBuffer(10, 2, 3, 2, seed=seed)
        buffer.add(*numbered(0, 8))
        return buffer

    first, second, third = filled(3), filled(3), filled(4)
    draws = first.sample(64).reward
    assert torch.equal(draws, second.sample(64).reward)
    assert not torch.equal(draws, third.sample(64).reward)
    third.load_state_dict(first.state_dict())
    assert torch.equal(first.sample(64).reward, third.sample(64).reward)
    for buffer in (first, third):
        buffer.add(*numbered(8, 5))
    assert held(first) == held(third) == list(range(3, 13))


def test_saved_state_is_tensors_of_the_filled_part():
    buffer = ReplayBuffer(10, 2, 3, 2)
    buffer.add(*numbered(0, 4))
    state = buffer.state_dict()
    assert all(isinstance(value, torch.Tensor) for value in state.values())
    assert len(state["obs"]) == 4


def test_mistakes_are_named():
    with pytest.raises(UserError, match="empty"):
        ReplayBuffer(4, 2, 3, 2).sample(1)
    with pytest.raises(UserError, match="replay_capacity"):
        ReplayBuffer(4, 2, 3, 2).add(*numbered(0, 5))
    with pytest.raises(UserError, match="capacity"):
        ReplayBuffer(0, 2, 3, 2)
    other = ReplayBuffer(4, 3, 3, 2)
    with pytest.raises(UserError, match="configuration"):
        other.load_state_dict(ReplayBuffer(4, 2, 3, 2).state_dict())
