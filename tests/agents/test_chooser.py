"""The chooser: which proposal it executes, and what its critics are trained towards."""

import torch

from tests.agents.conftest import trained


def proposals(agent, obs):
    """Noise of each actor's mean and their values, ``[actors, B, ...]``."""
    noise = agent.chunk(agent.distribution.squash(agent.moments(obs)[0]))
    noise = noise.unflatten(0, (-1, len(obs)))
    return noise, torch.stack([agent.reduced(agent.q_values(obs, each)) for each in noise])


def test_it_executes_the_proposal_with_the_larger_value(problem):
    agent = trained("chooser")
    obs = problem.batch(256, seed=3, dtype=agent.dtype).obs
    noise, values = proposals(agent, obs)
    choice = values.argmax(0)
    assert 0 < choice.sum() < len(obs)
    assert torch.equal(agent.mode(obs), noise[choice, torch.arange(len(obs))])


def test_one_proposal_is_from_the_strict_actor(problem):
    agent = trained("chooser")
    obs = problem.batch(64, seed=3, dtype=agent.dtype).obs
    turned = problem.obs_layout.transform(obs, torch.pi / 4)
    errors = [
        (there - problem.act_layout.transform(here, torch.pi / 4)).abs().max().item()
        for here, there in zip(proposals(agent, obs)[0], proposals(agent, turned)[0], strict=True)
    ]
    assert errors[0] < 1e-10 < 1e-3 < errors[1]


def test_its_target_takes_the_better_proposal(problem):
    agent = trained("chooser")
    batch = problem.batch(32, seed=4, dtype=agent.dtype, terminal=0.0)
    with torch.no_grad():
        following = agent.drawn(batch.next_obs, batch.next_obs)
        values = agent.reduced(agent._q(agent.target, following.obs, following.judged))
        target = agent.critic_target(batch, following)
    best = values.unflatten(0, (2, 32)).amax(0)
    wanted = agent.options.reward_scale * batch.reward + agent.options.gamma * best
    torch.testing.assert_close(target, wanted)


def test_the_sample_has_the_log_probability_of_its_actor(problem):
    agent = trained("chooser")
    obs = problem.batch(64, seed=3, dtype=agent.dtype).obs
    state = agent.generator.get_state()
    try:
        noise, log_prob = agent.sample(obs)
        agent.generator.set_state(state)
        both, densities = agent._sample(*agent.moments(obs))
    finally:
        agent.generator.set_state(state)
    rows = (agent.chunk(both).unflatten(0, (2, 64)) == noise).flatten(2).all(-1)
    assert rows.any(0).all()
    assert torch.equal(
        densities.unflatten(0, (2, 64))[rows.int().argmax(0), torch.arange(64)], log_prob
    )
