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
    return sorted(buffer.sample(2000, GAMMA).reward.unique().int().tolist())


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
    batch = buffer.sample(100, GAMMA)
    assert set(batch) == {*SHAPES, "discount"}
    for name in SHAPES:
        tensor = batch[name]
        assert torch.equal(tensor.flatten(1).mean(1) if tensor.ndim > 1 else tensor, batch.reward)
    assert batch.noise.shape == (100, 3, 2)


def test_keeps_copies():
    buffer = ReplayBuffer(4, SHAPES)
    rows = numbered(1, 2)
    buffer.add(rows)
    rows["obs"].zero_()
    assert buffer.sample(50, GAMMA).obs.min() >= 1


def test_holds_the_fields_that_were_asked_for():
    rows = numbered(0, 4)
    actions = torch.arange(16.0).view(4, 2, 2)
    step = Transition(**rows, actions=actions, truncated=torch.ones(4, dtype=torch.bool))
    buffer = ReplayBuffer(8, {"actions": (2, 2), "reward": (), "truncated": ()})
    buffer.add(step)
    batch = buffer.sample(64, GAMMA)
    assert set(batch) == {"actions", "reward", "truncated", "discount"}
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
    draws = first.sample(64, GAMMA).reward
    assert torch.equal(draws, second.sample(64, GAMMA).reward)
    assert not torch.equal(draws, third.sample(64, GAMMA).reward)
    third.load_state_dict(first.state_dict())
    assert torch.equal(first.sample(64, GAMMA).reward, third.sample(64, GAMMA).reward)
    for buffer in (first, third):
        buffer.add(numbered(8, 5))
    assert held(first) == held(third) == list(range(3, 13))
    assert len(first.state_dict()["rows"]["obs"]) == 10


def test_mistakes_are_named():
    with pytest.raises(UserError, match="empty"):
        ReplayBuffer(4, SHAPES).sample(1, GAMMA)
    with pytest.raises(UserError, match="replay_capacity"):
        ReplayBuffer(4, SHAPES).add(numbered(0, 5))
    with pytest.raises(UserError, match="capacity"):
        ReplayBuffer(0, SHAPES)
    other = ReplayBuffer(4, {**SHAPES, "obs": (3,)})
    with pytest.raises(UserError, match="configuration"):
        other.load_state_dict(ReplayBuffer(4, SHAPES).state_dict())


# Joined decisions: the next observation of one is the observation of the next.

JOINED = {
    "obs": (1,),
    "noise": (1,),
    "reward": (),
    "next_obs": (1,),
    "terminal": (),
    "truncated": (),
}
GAMMA = 0.5


def decisions(obs, next_obs, reward, terminal=(), truncated=()):
    """One decision of each environment; the last two name environments."""
    obs, next_obs, reward = (torch.tensor(x, dtype=torch.float32) for x in (obs, next_obs, reward))
    ends = [
        torch.tensor([float(i in which) for i in range(len(obs))])
        for which in (terminal, truncated)
    ]
    columns = {"obs": obs[:, None], "noise": 100 + obs[:, None], "next_obs": next_obs[:, None]}
    return {**columns, "reward": reward, "terminal": ends[0], "truncated": ends[1]}


def joined(buffer, n_step):
    """What each stored decision becomes: (reward, discount, next_obs, terminal, truncated)."""
    batch = buffer.sample(2000, GAMMA, n_step)
    assert torch.equal(batch.noise, 100 + batch.obs)  # the noise is that of the first decision
    names = ("reward", "discount", "next_obs", "terminal", "truncated")
    rows = zip(
        batch.obs.flatten().tolist(), *(batch[n].flatten().tolist() for n in names), strict=True
    )
    found = {}
    for obs, *row in rows:
        assert found.setdefault(obs, tuple(row)) == tuple(row)
    return found


def test_one_step_is_what_was_stored():
    buffer = ReplayBuffer(10, JOINED)
    buffer.add(decisions([0], [1], [-1]))
    buffer.add(decisions([1], [2], [-2], terminal=[0]))
    assert joined(buffer, 1) == {0: (-1, 0.5, 1, 0, 0), 1: (-2, 0.5, 2, 1, 0)}


def test_decisions_of_two_environments_are_joined_up_to_their_ends():
    """Environment 0 succeeds after three decisions, environment 1 reaches the time limit.

    Both begin anew; as it happens, in the state in which they ended.
    """
    buffer = ReplayBuffer(100, JOINED)
    buffer.add(decisions([0, 10], [1, 11], [-1, -16]))
    buffer.add(decisions([1, 11], [2, 12], [-2, -32], truncated=[1]))
    buffer.add(decisions([2, 12], [3, 13], [-4, -64], terminal=[0]))
    buffer.add(decisions([3, 13], [4, 14], [-8, -128]))
    two = {
        0: (-1 - 1, 0.25, 2, 0, 0),
        1: (-2 - 2, 0.25, 3, 1, 0),
        2: (-4, 0.5, 3, 1, 0),
        3: (-8, 0.5, 4, 0, 0),
        10: (-16 - 16, 0.25, 12, 0, 1),
        11: (-32, 0.5, 12, 0, 1),
        12: (-64 - 64, 0.25, 14, 0, 0),
        13: (-128, 0.5, 14, 0, 0),  # the newest decision of its environment
    }
    assert joined(buffer, 2) == two
    assert joined(buffer, 5) == {**two, 0: (-1 - 1 - 1, 0.125, 3, 1, 0)}


def test_what_begins_elsewhere_is_not_joined():
    """Fresh scenes: an episode stops without an end, the next decision is of another one."""
    buffer = ReplayBuffer(100, JOINED)
    buffer.add(decisions([0, 10], [1, 11], [-1, -1]))
    buffer.add(decisions([50, 60], [51, 61], [-2, -2]))
    assert joined(buffer, 3) == {
        0: (-1, 0.5, 1, 0, 0),
        10: (-1, 0.5, 11, 0, 0),
        50: (-2, 0.5, 51, 0, 0),
        60: (-2, 0.5, 61, 0, 0),
    }


@pytest.mark.parametrize("capacity", [6, 7, 8])
def test_joining_goes_around_the_end_of_the_ring_and_stops_at_its_newest_row(capacity):
    buffer = ReplayBuffer(capacity, JOINED)
    steps = 11
    for t in range(steps):
        buffer.add(decisions([t, 100 + t], [t + 1, 101 + t], [-1, -1]))
    last = joined(buffer, 3)
    assert len(last) == capacity
    for obs, row in last.items():
        left = min(3, steps - obs % 100)  # decisions of this environment from here on
        assert row == (-2 + 2 * 0.5**left, 0.5**left, obs + left, 0, 0)


def test_a_state_that_stays_the_same_is_not_joined_with_itself():
    buffer = ReplayBuffer(8, JOINED)
    buffer.add(decisions([7], [7], [-1]))
    assert joined(buffer, 4) == {7: (-1, 0.5, 7, 0, 0)}


def test_joining_goes_on_after_loading():
    buffer = ReplayBuffer(8, JOINED)
    for t in range(2):
        buffer.add(decisions([t, 100 + t], [t + 1, 101 + t], [-1, -1]))
    other = ReplayBuffer(8, JOINED)
    other.load_state_dict(buffer.state_dict())
    assert joined(other, 2) == joined(buffer, 2)
    assert joined(other, 2)[0] == (-1.5, 0.25, 2, 0, 0)
