"""The partially equivariant agent: its mixtures, and whether its gate finds what is broken."""

import pytest
import torch
from scipy.stats import rankdata

from symsteer.agents.agent import AgentContext
from symsteer.agents.partial import START, PartialAgent, PartialOptions
from symsteer.agents.replay import Transition
from symsteer.errors import UserError
from symsteer.policies.geometry import Field, Layout
from tests.agents.conftest import DOUBLE, errors, learn
from tests.marks import slow_except


def set_gates(agent, logit):
    """Gates that say the same everywhere."""
    for name in ("gate", "state_gate"):
        with torch.no_grad():
            for parameter in agent.networks[name].members[0][-1].parameters():
                parameter.zero_()
            agent.networks[name].members[0][-1].bias.fill_(logit - START)
        agent.networks[name].changed()


@pytest.mark.parametrize("critic", ["aliased", "sampler"])
def test_it_starts_equivariant(problem, critic):
    agent = problem.agent("partial", critic_kind=critic, **DOUBLE)
    assert max(errors(agent, problem).values()) < 1e-10
    set_gates(agent, 10.0)
    assert min(errors(agent, problem).values()) > 1e-2


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_mixtures_by_hand(problem, share):
    agent = problem.agent("partial", gate="soft", critic_kind="sampler", **DOUBLE)
    set_gates(agent, torch.logit(torch.tensor(share), eps=1e-12).item())
    batch = problem.batch(8, dtype=torch.float64)
    outputs = agent.actor(batch.obs)
    (strict, strict_log), (plain, plain_log) = map(agent.distribution.parameters_of, outputs)
    mean, log_scale = agent.moments(batch.obs)
    # log pi_E^(1 - lambda) pi_N^lambda is quadratic: compare it with the mixture's, but for a
    # constant.
    points = torch.randn(5, *mean.shape, generator=torch.Generator().manual_seed(0)).double()

    def exponent(mean, log_scale):
        scale = agent.distribution.spread(log_scale.exp())
        return -0.5 * ((points - mean) / scale).square().sum(-1)

    parts = (1 - share) * exponent(strict, strict_log) + share * exponent(plain, plain_log)
    whole = exponent(mean, log_scale)
    # The logit was made in single precision.
    torch.testing.assert_close(parts - parts[0], whole - whole[0], rtol=1e-5, atol=1e-5)
    q = agent.q_values(batch.obs, batch.noise)
    inputs = torch.cat([batch.obs, agent.judged(batch.obs, batch.noise.flatten(1))], -1)
    both = agent.critic(inputs)[..., 0]
    expected = (1 - share) * both[:2] + share * both[2:]
    torch.testing.assert_close(q, expected / agent.options.reward_scale, rtol=1e-5, atol=1e-5)


def test_actor_and_critics_have_no_gradient_in_the_gates(problem):
    agent = problem.agent("partial", gate="soft", **DOUBLE)
    agent.after_update = lambda batch: {}
    learn(problem, agent, 2)
    for name in ("strict_predictor", "plain_predictor", "gate", "state_gate"):
        assert all(p.grad is None for p in agent.networks[name].parameters())


# A point that moves by its action; where x is large, the wind carries it away.

OBS = Layout([Field("xy", 1), Field("height", 0)])
ACT = Layout([Field("xy", 1)])
FAR = 0.7


def world(broken, count=2048):
    generator = torch.Generator().manual_seed(0)
    obs = torch.randn(count, OBS.dim, generator=generator)
    noise = torch.randn(count, 2, ACT.dim, generator=generator)
    windy = obs[:, 0] > FAR
    after = obs.clone()
    after[:, :2] += 0.3 * noise[:, 0].clamp(-1, 1)
    reward = torch.full((count,), -1.0)
    if broken == "dynamics":
        after[windy, 1] += 0.4
    if broken == "reward":
        reward[windy] -= 1.0
    nothing = torch.zeros(count)
    return Transition(obs, noise, noise[:, :1].clamp(-1, 1), reward, after, nothing, nothing), windy


def learned(broken):
    context = AgentContext(OBS, ACT, 2, 1, lambda obs, noise: noise.clamp(-1, 1), lambda obs: obs)
    settings = {"width": 64, "lr": 3e-3, "batch_size": 128, "warmup": 0, "utd": 1e-9}
    agent = PartialAgent(context, PartialOptions(gate="soft", **settings))
    transition, windy = world(broken)
    agent.observe(transition)
    agent.owed += 400
    for batch in agent.batches():
        agent.update(batch)
    return agent, transition, windy


def auroc(score, label):
    ranks = torch.tensor(rankdata(score.numpy()))
    positive = int(label.sum())
    wins = ranks[label].sum() - positive * (positive + 1) / 2
    return (wins / (positive * (len(label) - positive))).item()


@pytest.mark.long
@pytest.mark.parametrize("broken", slow_except(["dynamics", "reward"], "dynamics"))
def test_the_gates_find_where_the_symmetry_is_broken(broken):
    agent, seen, windy = learned(broken)
    share = agent.share(seen.obs, seen.actions)
    assert auroc(share, windy) > 0.9
    of_states = agent._share(agent._features(seen.obs), None)
    assert auroc(of_states, windy) > 0.9
    assert of_states[windy].mean() > 0.3 > 0.15 > of_states[~windy].mean()


@pytest.mark.long
def test_in_a_symmetric_world_they_stay_closed():
    agent, seen, windy = learned("nothing")
    share = agent._share(agent._features(seen.obs), None)
    assert share.mean() < 0.35
    of_actions = agent.share(seen.obs, seen.actions)
    assert auroc(of_actions, windy) < 0.75


def test_noise_and_actions_must_differ():
    context = AgentContext(OBS, ACT, 1, 1, lambda obs, noise: noise, lambda obs: obs)
    with pytest.raises(UserError, match="whole chunk is executed"):
        PartialAgent(context, PartialOptions(width=16))
    PartialAgent(context, PartialOptions(width=16, critic_kind="sampler"))
