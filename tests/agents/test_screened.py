"""The screened agent: the ends of its dial, and when it leaves the symmetry."""

import dataclasses

import pytest
import torch

from symsteer.agents.agent import Budget
from symsteer.agents.replay import Transition
from symsteer.agents.team import Team
from symsteer.errors import UserError
from tests.agents.conftest import errors

ENVS = 40


def play(problem, agent, seed=0, shift=0.0, decisions=8):
    """Episodes of four decisions, seen with a shift of the goal along x; then updates."""
    generator = torch.Generator().manual_seed(seed)

    def seen():
        obs = torch.randn(ENVS, problem.obs_layout.dim, generator=generator)
        obs[:, problem.obs_layout.slice("goal_xy")] += torch.tensor([shift, 0.0])
        return obs

    obs = seen()
    for decision in range(decisions):
        noise = torch.randn(ENVS, problem.horizon, problem.act_layout.dim, generator=generator)
        following, nothing = seen(), torch.zeros(ENVS)
        actions = agent.executed(obs, noise)
        agent.observe(Transition(obs, noise, actions, nothing - 1, following, nothing, nothing))
        obs = following if decision % 4 < 3 else seen()
    for batch in agent.batches():
        agent.update(batch)


def screened(problem, **options):
    return problem.agent("screened", warmup=6 * ENVS, utd=0.1, **options)


@pytest.mark.parametrize(
    ("level", "other"), [(0.0, "equivariant"), (1.0, "residual-pathway")], ids=["never", "always"]
)
def test_the_ends_of_its_dial_are_the_two_agents(problem, level, other):
    agents = [screened(problem, level=level, penalty=3.0)]
    options = {"penalty": 3.0} if other == "residual-pathway" else {}
    agents.append(problem.agent(other, warmup=6 * ENVS, utd=0.1, **options))
    for agent in agents:
        play(problem, agent)
        assert agent.updates == 8
    batch = problem.batch(seed=9)
    one, two = (agent.moments(batch.obs)[0] for agent in agents)
    torch.testing.assert_close(one, two, rtol=1e-5, atol=1e-6)
    one, two = (agent.q_values(batch.obs, batch.noise) for agent in agents)
    torch.testing.assert_close(one, two, rtol=1e-5, atol=1e-6)


def test_it_leaves_the_symmetry_where_opposite_sides_are_unlike(problem):
    for shift in (0.0, 0.7):
        agent = screened(problem)
        play(problem, agent, shift=shift)
        assert (agent.direction <= 0.01) == (shift > 0)
        assert (max(errors(agent, problem).values()) > 1e-3) == (shift > 0)


def test_it_asks_once_after_the_warm_up(problem):
    agent = screened(problem)
    play(problem, agent, decisions=5)
    assert agent.direction is None
    play(problem, agent, decisions=1)
    asked = agent.direction
    assert asked > 0.01
    play(problem, agent, shift=5.0)
    assert agent.direction == asked


def test_it_tells_episodes_apart(problem, monkeypatch):
    """By environment and number; an episode is what a test turns as a whole."""
    asked = []
    monkeypatch.setattr(
        "symsteer.agents.screened.sides",
        lambda *given: asked.append(given) or dataclasses.make_dataclass("S", ["direction"])(1.0),
    )
    play(problem, screened(problem))
    *_, obs, _, following, episodes, _ = asked[0]
    assert len(episodes.unique()) == 2 * ENVS
    for number in episodes.unique():
        rows = (episodes == number).nonzero().flatten()
        assert len(rows) in (4, 2)
        assert torch.equal(obs[rows[1:]], following[rows[:-1]])


def test_a_loaded_agent_goes_on_alike(problem):
    for warm in (4, 7):
        whole, first = screened(problem), screened(problem)
        for agent in (whole, first):
            play(problem, agent, shift=0.7, decisions=warm)
        second = screened(problem)
        second.load_state_dict(first.state_dict())
        second.replay.load_state_dict(first.replay.state_dict())
        for agent in (whole, second):
            play(problem, agent, seed=1, shift=0.7, decisions=4)
        assert second.direction == whole.direction <= 0.01
        obs = problem.batch().obs
        assert torch.equal(whole.act(obs, True), second.act(obs, True))


def test_the_replay_must_hold_the_warm_up(problem):
    agent = screened(problem, replay_capacity=100)
    with pytest.raises(UserError, match=r"too small for the warm-up of 240 decisions"):
        agent.check(agent.options, Budget(10_000, ENVS, 2, 50))


def test_options_out_of_range_are_refused(problem):
    with pytest.raises(UserError, match="agent option level must lie in"):
        screened(problem, level=1.5)


def test_members_of_a_team_decide_for_themselves(problem):
    """One of them sees a shift; each learns what it learns alone."""
    shifts = (0.7, 0.0)
    alone, members = ([screened(problem, seed=s) for s in (0, 1)] for _ in range(2))
    team = Team(members)
    for pair in zip(alone, members, strict=True):
        for agent in pair:
            play(problem, agent, shift=shifts[agent.context.seed], decisions=6)
    assert [member.direction <= 0.01 for member in members] == [True, False]
    for _ in range(5):
        for agent in alone:
            agent.update(agent.new_batch())
        team.update([member.new_batch() for member in members])
    obs = problem.batch().obs
    for one, other in zip(alone, members, strict=True):
        torch.testing.assert_close(one.act(obs, True), other.act(obs, True), rtol=1e-4, atol=1e-5)
    opened, closed = (max(errors(member, problem).values()) for member in members)
    assert opened > 1e-3 > closed
