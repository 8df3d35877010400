"""The ring of transitions."""

import pytest
import torch

from symsteer.agents import replay
from symsteer.agents.replay import ReplayBuffer, Transition
from symsteer.errors import UserError

SHAPES = {"obs": (2,), "noise": (3, 2), "reward": (), "next_obs": (2,), "terminal": ()}


def numbered(start, count):
    n = torch.arange(start, start + count, dtype=torch.float32)
    return {
        "obs": n[:, None].repeat(1, 2),
        "noise": n[:, None, None].repeat(1, 3, 2),
        "reward": n,
        "next_obs": n[:, None].repeat(1, 2),
        "terminal": n,
    }


def held(buffer):
    return sorted(buffer.sample(2000).reward.unique().int().tolist())


@pytest.mark.parametrize("first_rows", [1, 3, 4096])
def test_wraps_around_and_forgets_the_oldest(monkeypatch, first_rows):
    monkeypatch.setattr(replay, "FIRST_ROWS", first_rows)
    buffer = ReplayBuffer(10, SHAPES)
    buffer.add(numbered(0, 4))
    assert (len(buffer), held(buffer)) == (4, [0, 1, 2, 3])
    buffer.add(numbered(4, 4))
    buffer.add(numbered(8, 4))  # crosses the end
    assert (len(buffer), held(buffer)) == (10, list(range(2, 12)))
    buffer.add(numbered(12, 10))
    assert held(buffer) == list(range(12, 22))


def test_rows_stay_together():
    buffer = ReplayBuffer(7, SHAPES)
    for start in range(0, 20, 4):
        buffer.add(numbered(start, 4))
    batch = buffer.sample(100)
    assert set(batch) == set(SHAPES)
    for name in SHAPES:
        tensor = batch[name]
        assert torch.equal(tensor.flatten(1).mean(1) if tensor.ndim > 1 else tensor, batch.reward)
    assert batch.noise.shape == (100, 3, 2)


def test_keeps_copies():
    buffer = ReplayBuffer(4, SHAPES)
    rows = numbered(1, 2)
    buffer.add(rows)
    rows["obs"].zero_()
    assert buffer.sample(50).obs.min() >= 1


def test_holds_the_fields_that_were_asked_for():
    rows = numbered(0, 4)
    actions = torch.arange(16.0).view(4, 2, 2)
    step = Transition(**rows, actions=actions, truncated=torch.ones(4, dtype=torch.bool))
    buffer = ReplayBuffer(8, {"actions": (2, 2), "reward": (), "truncated": ()})
    buffer.add(step)
    batch = buffer.sample(64)
    assert set(batch) == {"actions", "reward", "truncated"}
    assert torch.equal(batch.actions.unique(), torch.arange(16.0))
    assert batch.truncated.eq(1).all()
    with pytest.raises(
        AttributeError, match="holds no 'noise'; it holds actions, reward, truncated"
    ):
        _ = batch.noise


def test_sampling_is_seeded_and_continues_after_loading():
    def filled(seed):
        buffer = ReplayBuffer(10, SHAPES, seed=seed)
        buffer.add(numbered(0, 8))
        return buffer

    first, second, third = filled(3), filled(3), filled(4)
    draws = first.sample(64).reward
    assert torch.equal(draws, second.sample(64).reward)
    assert not torch.equal(draws, third.sample(64).reward)
    third.load_state_dict(first.state_dict())
    assert torch.equal(first.sample(64).reward, third.sample(64).reward)
    for buffer in (first, third):
        buffer.add(numbered(8, 5))
    assert held(first) == held(third) == list(range(3, 13))
    assert len(first.state_dict()["rows"]["obs"]) == 10


def test_mistakes_are_named():
    with pytest.raises(UserError, match="empty"):
        ReplayBuffer(4, SHAPES).sample(1)
    with pytest.raises(UserError, match="capacity"):
        ReplayBuffer(0, SHAPES)
    other = ReplayBuffer(4, {**SHAPES, "obs": (3,)})
    with pytest.raises(UserError, match="configuration"):
        other.load_state_dict(ReplayBuffer(4, SHAPES).state_dict())
