"""Best of n: what it plays, what its critics learn, and what it does not do."""

import pytest
import torch

from tests.agents.conftest import EXECUTE
from tests.agents.test_known_values import GAMMA, best, play, reach, states, step

DOUBLE = {"dtype": torch.float64}


def test_it_plays_the_candidate_that_its_critics_prefer(problem):
    agent = problem.agent("best-of-n", noise_bank=6, **DOUBLE)
    obs = problem.batch(16, dtype=torch.float64).obs
    before = agent.generator.get_state()
    played = agent.act(obs, deterministic=True)
    agent.generator.set_state(before)
    candidates = agent.gaussian_noise(6 * 16).unflatten(0, (16, 6))
    q = torch.stack([agent.q_values(obs, candidates[:, i]).amin(0) for i in range(6)], 1)
    assert torch.equal(played, candidates[torch.arange(16), q.argmax(1)])
    assert not torch.equal(played, candidates[:, 0])


def test_with_one_candidate_it_is_the_base_policy(problem):
    agent = problem.agent("best-of-n", noise_bank=1, seed=4, **DOUBLE)
    base = problem.agent("base", seed=4, **DOUBLE)
    obs = problem.batch(16, dtype=torch.float64).obs
    assert torch.equal(agent.act(obs, deterministic=True), base.act(obs))


def test_the_target_takes_the_best_candidate_of_the_next_state(problem):
    agent = problem.agent("best-of-n", noise_bank=4, **DOUBLE)
    agent.observe(problem.transition(64))
    batch = agent.replay.sample(32)
    # The bank is decoded at the next state.
    noise = batch["bank_noise"]
    for i in range(4):
        wanted = agent.context.decode(batch.next_obs, noise[:, i])[:, :EXECUTE]
        torch.testing.assert_close(batch["bank_actions"][:, i], wanted)
    target = agent.critic_target(batch, agent.drawn(batch.next_obs, batch.next_obs))
    # At the start the targets are the critics.
    q = [agent.q_values(batch.next_obs, noise[:, i]).amin(0) for i in range(4)]
    following = torch.stack(q).amax(0)
    expected = batch.reward + agent.options.gamma * (1 - batch.terminal) * following
    torch.testing.assert_close(target, expected)


@pytest.mark.long
def test_with_many_candidates_it_is_almost_the_best():
    agent = reach("best-of-n", noise_bank=64)
    obs = states(512, torch.Generator().manual_seed(2))
    way = play(obs, lambda obs: agent.executed(obs, agent.act(obs, deterministic=True)))
    assert way.mean() > best(obs).mean() - 0.35
    random = play(obs, lambda obs: agent.executed(obs, agent.gaussian_noise(len(obs))))
    assert random.mean() < way.mean() - 0.5


def test_its_critics_learn_the_values_of_the_best_of_few():
    """Of one candidate, those of the base policy: the mean over many played episodes."""
    agent = reach("best-of-n", noise_bank=1)
    generator = torch.Generator().manual_seed(2)
    obs = states(512, generator)
    noise = agent.gaussian_noise(512, generator)
    after, close = step(obs, agent.executed(obs, noise))
    draws = [
        play(after, lambda obs: agent.executed(obs, agent.gaussian_noise(len(obs))))
        for _ in range(32)
    ]
    returns = -1 + GAMMA * torch.where(close, 0, torch.stack(draws).mean(0))
    q = agent.q_values(obs, noise).mean(0)
    assert abs((q - returns).mean()) < 0.15
    assert torch.corrcoef(torch.stack([q, returns]))[0, 1] > 0.8
