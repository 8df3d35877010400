"""The balanced agent: who plays, who leads, and what all learn from."""

import dataclasses
import itertools

import pytest
import torch

from symsteer.agents.agent import Budget
from symsteer.agents.balanced import Balance, BalancedOptions
from symsteer.errors import UserError

BUDGET = Budget(env_steps=1000, num_envs=4, execute=2, max_episode_steps=10)


def test_a_worse_learner_plays_fewer_episodes_and_does_not_lead():
    balance = Balance(3, BalancedOptions())
    generator = torch.Generator().manual_seed(0)
    for _ in range(600):
        learner = balance.begin()
        chance = (0.8, 0.8, 0.3)[learner]
        balance.end(learner, float(torch.rand((), generator=generator) < chance))
    assert balance.plays[2] < 130 < 200 < min(balance.plays[:2])
    assert balance.best != 2


def test_a_learner_that_rises_late_leads_in_the_end():
    """Its success rises from .4 to .95 in the last two thirds of 540 episodes, 64 at a time."""
    leads = 0
    for seed in range(10):
        balance = Balance(3, BalancedOptions())
        generator = torch.Generator().manual_seed(seed)
        for done in range(0, 540, 64):
            rising = 0.4 + 0.825 * max(0.0, done / 540 - 1 / 3)
            for learner in [balance.begin() for _ in range(64)]:
                chance = rising if learner == 0 else 0.6
                balance.end(learner, 0.6 * float(torch.rand((), generator=generator) < chance))
        leads += balance.best == 0
    assert leads >= 8


def test_equal_learners_share_the_episodes():
    balance = Balance(3, BalancedOptions())
    for _ in range(300):
        balance.end(balance.begin(), 0.5)
    assert max(balance.plays) - min(balance.plays) <= 2
    assert balance.bounds == [BalancedOptions().bound] * 3


def test_episodes_under_way_and_given_up_count_as_they_should():
    balance = Balance(3, BalancedOptions())
    assert [balance.begin() for _ in range(4)] == [0, 1, 0, 2]
    balance.end(0, None)
    assert balance.pending == [1, 1, 1]
    assert balance.plays == [0, 0, 0]


def test_a_bound_doubles_where_a_learner_is_worse_in_spite_of_it():
    """By hand, with n = 100 and no doubt: .5 + .1 / 10 < .52, not < .505."""
    for other, wanted in ((0.52, 0.2), (0.505, 0.1)):
        balance = Balance(2, BalancedOptions(confidence=0.0))
        balance.plays, balance.scores, balance.pending = [99, 100], [49.5, 100 * other], [1, 0]
        balance.end(0, 0.5)
        assert balance.bounds[0] == pytest.approx(wanted)


def steps(problem, agent, count, terminal=0.0):
    """Decisions of four environments, one after the other."""
    batches = [problem.transition(4, seed) for seed in range(count + 1)]
    for batch, after in itertools.pairwise(batches):
        zeros = torch.zeros(4)
        ends = zeros + terminal
        agent.act(batch.obs)
        agent.observe(
            dataclasses.replace(
                batch, next_obs=after.obs, reward=zeros - 1, terminal=ends, truncated=zeros
            )
        )
        for due in agent.batches():
            agent.update(due)


def test_scores_are_returns_as_a_share_of_the_limit(problem):
    agent = problem.agent("balanced")
    agent.prepare(None, BUDGET)
    steps(problem, agent, 3)
    assert sum(agent.balance.plays) == 0
    steps(problem, agent, 1, terminal=1.0)
    # The second loop began other episodes, so that the first ones were given up.
    assert sum(agent.balance.plays) == 4
    assert sum(agent.balance.scores) == pytest.approx(4 * 0.9)


def test_episodes_of_the_warm_up_do_not_count(problem):
    agent = problem.agent("balanced", warmup=8)
    agent.prepare(None, BUDGET)
    steps(problem, agent, 2, terminal=1.0)
    assert sum(agent.balance.plays) == 0
    steps(problem, agent, 2, terminal=1.0)
    assert sum(agent.balance.plays) == 8


def test_all_learn_from_all_decisions(problem):
    agent = problem.agent("balanced", utd=0.5)
    agent.prepare(None, BUDGET)
    steps(problem, agent, 4)
    assert len(agent.replay) == 16
    assert [learner.updates for learner in agent.learners] == [8] * 3
    assert [learner.decisions for learner in agent.learners] == [16] * 3
    assert all(learner.replay is agent.replay for learner in agent.learners)


def test_learners_play_different_noise_in_the_warm_up(problem):
    agent = problem.agent("balanced", warmup=100)
    noise = agent.act(problem.batch(12).obs)
    assert len(noise.flatten(1).unique(dim=0)) == 12


def test_evaluations_play_the_best_one(problem):
    agent = problem.agent("balanced")
    obs = problem.batch(8, seed=3).obs
    for index, learner in enumerate(agent.learners):
        agent.balance.recent = [(float(i == index), 1.0) for i in range(3)]
        assert torch.equal(agent.act(obs, True), learner.act(obs, True))


def test_a_loaded_agent_goes_on_alike(problem):
    whole, first = problem.agent("balanced"), problem.agent("balanced")
    for agent in (whole, first):
        agent.prepare(None, BUDGET)
        steps(problem, agent, 3, terminal=1.0)
    second = problem.agent("balanced")
    second.load_state_dict(first.state_dict())
    second.replay.load_state_dict(first.replay.state_dict())
    for agent in (whole, second):
        steps(problem, agent, 3, terminal=1.0)
    assert whole.balance.plays == second.balance.plays
    for one, other in zip(whole.networks.values(), second.networks.values(), strict=True):
        assert all(map(torch.equal, one.parameters(), other.parameters()))


@pytest.mark.parametrize("option", [{"bound": 0.0}, {"memory": 1.0}, {"confidence": -1.0}])
def test_options_out_of_range_are_refused(option):
    with pytest.raises(UserError, match=f"agent option {next(iter(option))} must"):
        BalancedOptions(**option)


def test_a_checkpoint_with_other_learners_is_refused(problem):
    agent = problem.agent("balanced")
    agent.prepare(None, BUDGET)
    steps(problem, agent, 2)
    for change in ({"players": [0, 1, 2, 7]}, {"players": [0, 1]}):
        with pytest.raises(ValueError, match=r"played by the learners|not every environment"):
            problem.agent("balanced").load_state_dict({**agent.state_dict(), **change})
