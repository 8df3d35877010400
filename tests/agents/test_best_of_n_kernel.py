"""Best of n with a kernel critic: returns, regression, invariance, and what it gains."""

import math

import pytest
import torch

from symsteer.agents import best_of_n_kernel as bk
from symsteer.agents.agent import AgentContext, Budget
from symsteer.agents.best_of_n_kernel import KernelBestOfNAgent, KernelOptions
from symsteer.agents.replay import Transition
from symsteer.errors import UserError
from symsteer.policies.geometry import Group
from tests.agents.test_known_values import ACT, FAR, GAMMA, OBS, best, decode, play, states, step


def made(dtype=torch.float64, seed=0, **options):
    context = AgentContext(OBS, ACT, 2, 1, decode, lambda obs: obs / 2, dtype=dtype, seed=seed)
    return KernelBestOfNAgent(context, KernelOptions(gamma=GAMMA, **options))


def decisions(obs, actions, reward, following, terminal, truncated):
    return Transition(
        obs,
        torch.zeros(len(obs), 2, ACT.dim),
        actions,
        torch.as_tensor(reward, dtype=obs.dtype),
        following,
        torch.as_tensor(terminal, dtype=obs.dtype),
        torch.as_tensor(truncated, dtype=obs.dtype),
    )


def learned(agent, rounds=40, count=64, limit=6):
    """After episodes of its own, which end after ``limit`` decisions at the latest."""
    generator = torch.Generator().manual_seed(1)
    obs, age = states(count, generator).to(agent.dtype), torch.zeros(count)
    for _ in range(rounds):
        noise = agent.act(obs)
        actions = agent.decode(obs, noise)[:, :1]
        after, close = step(obs, actions)
        out = (after[:, :2].norm(dim=1) > 2 * FAR) & ~close
        late = (age + 1 >= limit) & ~close | out
        agent.observe(decisions(obs, actions, [-1.0] * count, after, close, late))
        age = torch.where(close | late, 0, age + 1)
        new = states(count, generator).to(agent.dtype)
        obs = torch.where((close | late)[:, None], new, after)
    return agent


def test_returns_end_with_success_and_go_on_after_a_time_out():
    """Two environments; the second one begins a new episode after its first decision."""
    agent = made(candidates=1, refit=100)
    s = torch.randn(5, 2, OBS.dim, dtype=torch.float64)
    act = torch.zeros(2, 1, ACT.dim, dtype=torch.float64)
    agent.observe(decisions(s[0], act, [-1, -2], s[1], [0, 0], [0, 1]))
    fresh = torch.stack([s[1, 0], s[4, 1]])
    agent.observe(decisions(fresh, act, [-3, -4], s[2], [0, 0], [0, 0]))
    agent.observe(decisions(s[2], act, [-5, -6], s[3], [1, 0], [0, 0]))
    found = agent._returns(agent.replay.in_order()).view(3, 2)
    tail = -21 / 6 / (1 - GAMMA)
    last = torch.tensor([-5.0, -6 + GAMMA * tail], dtype=torch.float64)
    middle = torch.tensor([-3.0, -4.0], dtype=torch.float64) + GAMMA * last
    first = torch.tensor([-1 + GAMMA * middle[0], -2 + GAMMA * tail], dtype=torch.float64)
    torch.testing.assert_close(found, torch.stack([first, middle, last]))


def test_episodes_that_are_left_for_fresh_scenes_are_loose_ends():
    """No flag says so: the next observation is another one. A time-out ends, whatever follows."""
    agent = made(candidates=1, refit=100)
    s = torch.randn(4, 2, OBS.dim, dtype=torch.float64)
    act = torch.zeros(2, 1, ACT.dim, dtype=torch.float64)
    agent.observe(decisions(s[0], act, [-1, -2], s[1], [0, 0], [0, 1]))
    agent.observe(decisions(torch.stack([s[3, 0], s[1, 1]]), act, [-3, -4], s[2], [1, 1], [0, 0]))
    found = agent._returns(agent.replay.in_order())
    tail = -10 / 4 / (1 - GAMMA)
    assert found.tolist() == pytest.approx([-1 + GAMMA * tail, -2 + GAMMA * tail, -3, -4])


def test_the_marginal_likelihood_is_that_of_a_gaussian():
    agent = learned(made(refit=320, points=320), rounds=5)
    generator = torch.Generator().manual_seed(4)
    inputs = torch.randn(40, OBS.dim + ACT.dim, generator=generator, dtype=torch.float64)
    wanted = torch.randn(40, generator=generator, dtype=torch.float64)
    length, ridge = 0.7, 0.3
    kernel = bk._kernel(inputs / length, agent._orbits(inputs / length))
    covariance = kernel + ridge * torch.eye(40)
    best = wanted @ covariance.inverse() @ wanted / 40
    density = torch.distributions.MultivariateNormal(torch.zeros(40).double(), best * covariance)
    constant = 0.5 * (1 + math.log(2 * math.pi))
    found = bk._likelihood(kernel, wanted, ridge)
    # The logarithms nearly cancel: a relative tolerance alone is too strict.
    assert found == pytest.approx(density.log_prob(wanted).item() / 40 + constant, abs=1e-7)


def test_only_whole_steps_of_the_last_points_are_used_oldest_first():
    agent = made(points=7, refit=100)
    act = torch.zeros(2, 1, ACT.dim)
    for t in range(6):
        obs = torch.full((2, OBS.dim), float(t))
        agent.observe(decisions(obs, act, [t, t + 0.5], obs, [0, 0], [0, 0]))
    assert agent.replay.in_order()["reward"].tolist() == [3.0, 3.5, 4.0, 4.5, 5.0, 5.5]


def test_values_are_those_of_the_gaussian_process_with_the_averaged_kernel():
    agent = learned(made(refit=320, points=320), rounds=5)
    rows = agent.replay.in_order()
    to_obs, to_actions, length = agent.fitted["scales"]
    turns = [
        torch.cat(
            [
                OBS.transform(rows["obs"] / 2, *g) / to_obs,
                ACT.transform(rows["actions"][:, 0], *g) / to_actions,
            ],
            1,
        )
        / length
        for g in Group.parse("C8").elements
    ]
    kernel = sum((-0.5 * torch.cdist(turns[0], x).square()).exp() for x in turns) / len(turns)
    q = agent._values(rows["obs"], rows["actions"].flatten(1))
    torch.testing.assert_close(q, agent.fitted["prior"] + kernel @ agent.fitted["coefficients"])
    assert q.std() > 0.1


@pytest.mark.parametrize(("group", "invariant"), [("C8", True), ("C4", False), ("C1", False)])
def test_the_critic_has_the_symmetry_of_its_group(group, invariant):
    agent = learned(made(group=group, refit=320), rounds=5)
    generator = torch.Generator().manual_seed(3)
    obs = states(32, generator).double()
    noise = torch.randn(32, 2, ACT.dim, generator=generator, dtype=torch.float64)
    eighth = Group.parse("C8").elements[1]
    q, turned = (
        agent.q_values(o, n)
        for o, n in ((obs, noise), (OBS.transform(obs, *eighth), ACT.transform(noise, *eighth)))
    )
    assert torch.allclose(q, turned, atol=1e-9) == invariant


@pytest.mark.slow
def test_it_is_the_base_policy_before_its_first_fit_and_much_better_later():
    agent = made(candidates=16, refit=320)
    obs = states(512, torch.Generator().manual_seed(2)).double()

    def played():
        return play(obs, lambda obs: agent.decode(obs, agent.act(obs, True))[:, :1]).mean()

    before = played()
    base = play(obs, lambda obs: agent.decode(obs, agent.gaussian_noise(len(obs)))[:, :1]).mean()
    assert abs(before - base) < 0.15
    learned(agent)
    assert played() > base + 0.5 * (best(obs).mean() - base)


def test_a_checkpoint_continues_exactly():
    first, second = made(refit=320), made(refit=320, seed=7)
    learned(first, rounds=6)
    second.load_state_dict(first.state_dict())
    second.replay.load_state_dict(first.replay.state_dict())
    for agent in (first, second):
        learned(agent, rounds=9)
    obs = states(16, torch.Generator().manual_seed(5)).double()
    assert first.fits == second.fits > 2
    assert torch.equal(first.act(obs), second.act(obs))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"candidates": 0}, "candidates must be at least 1"),
        ({"refit": 0}, "refit must be at least 1"),
        ({"gamma": 1.0}, "gamma must be between 0 and 1"),
        ({"group": "SO2"}, "not finite"),
    ],
)
def test_bad_options_are_refused(options, words):
    with pytest.raises(UserError, match=words):
        KernelOptions(**options)


def test_a_budget_without_a_fit_is_refused():
    with pytest.raises(UserError, match="before the first fit at 2560"):
        KernelBestOfNAgent.check(KernelOptions(), Budget(2_000, 64, 4, 50))
    with pytest.raises(UserError, match="points is 32"):
        KernelBestOfNAgent.check(KernelOptions(points=32), Budget(20_000, 64, 4, 50))
