"""Every diagnostic against a case whose answer is known."""

import math
from types import SimpleNamespace

import pytest
import torch

from symsteer.agents import diagnostics
from symsteer.agents.episodes import LongEpisodes, Played, Rollout
from symsteer.policies.geometry import Group
from tests.agents.conftest import trained

C8 = Group.parse("C8")


def test_bound_violation_counts_and_measures_what_is_outside():
    q = torch.tensor([[-25.0, -20.0, -3.0, 0.0], [0.1, 5.0, -1.0, -2.0]])
    report = diagnostics.bound_violation(q, -20.0, 0.0)
    assert report == {
        "q_abs_max": 25.0,
        "q_magnitude": 25 / 20,
        "q_overshoot": 5 / 20,
        "q_violation": 3 / 8,
    }
    # Above the interval by more than below it, and of a feasible size.
    above = diagnostics.bound_violation(q[1], -20.0, 0.0)
    assert (above["q_magnitude"], above["q_overshoot"]) == (5 / 20, 5 / 20)
    inside = diagnostics.bound_violation(q[0, 1:], -20.0, 0.0)
    assert (inside["q_magnitude"], inside["q_overshoot"], inside["q_violation"]) == (1, 0, 0)
    for value in (math.nan, math.inf):
        q[0, 1] = value
        report = diagnostics.bound_violation(q, -20.0, 0.0)
        assert report["q_violation"] == 4 / 8
        assert not math.isfinite(report["q_magnitude"])
        assert not math.isfinite(report["q_overshoot"])


def test_returns_by_hand():
    """Success, time-out with an unknown future, and a column that goes on after its end."""
    reward = torch.tensor([[-1.0, -1.0, -1.0], [-1.0, -1.0, 0.0], [0.0, -1.0, -9.0]])
    ends = torch.tensor([[0, 0, 0], [0, 0, 1], [1, 0, 0]]).bool()
    last = torch.tensor([[0, 0, 0], [0, 0, 0], [0, 1, 0]]).bool()
    bonus = torch.tensor([[7.0] * 3, [0.5] * 3, [0.25] * 3])
    returns = diagnostics.discounted_returns(reward, ends, last, 0.5, bonus)
    # The last decision, with -1 and a bonus of 0.25, goes on for ever.
    third = -1 + 0.5 * 2 * (-1 + 0.25)
    second = -1 + 0.5 * (third + 0.25)
    assert returns[:, 0].tolist() == [-1 + 0.5 * (-0.875 + 0.5), -1 + 0.5 * 0.25, 0.0]
    assert returns[:, 1].tolist() == [-1 + 0.5 * (second + 0.5), second, third]
    assert returns[:2, 2].tolist() == [-1 + 0.5 * 0.5, 0.0]


def test_agreement_by_hand():
    q = torch.tensor([1.0, 2.0, 3.0, 9.0] * 2, dtype=torch.float64)
    returns = torch.tensor([2.0, 1.0, 4.0, 5.0] * 2, dtype=torch.float64)
    assert diagnostics.agreement(q, returns) == pytest.approx(
        {
            "bias": 0.75,
            "bias_std": torch.tensor([-1.75, 0.25, -1.75, 3.25]).std(unbiased=False).item(),
            "correlation": 16 / (38.75 * 10) ** 0.5,
            "rank_correlation": 0.8,
            "overestimated": 0.5,
            "decisions": 8,
        }
    )
    few = diagnostics.agreement(q[:7], returns[:7])
    assert few["correlation"] is few["rank_correlation"] is None
    assert few["bias"] is not None
    nothing = diagnostics.agreement(q[:0], q[:0])
    assert nothing.pop("decisions") == 0
    assert set(nothing.values()) == {None}


def test_orbit_variance_is_the_variance_over_the_orbit(problem):
    part = problem.obs_layout.slice("tcp_xy")
    linear = SimpleNamespace(
        obs_layout=problem.obs_layout,
        act_layout=problem.act_layout,
        q_values=lambda obs, noise: obs[:, part][:, 0][None],
    )
    batch = problem.batch(16)
    variance = diagnostics.orbit_variance(linear, batch.obs, batch.noise, C8)
    radius2 = batch.obs[:, part].square().sum(1)
    assert variance == pytest.approx(radius2.mean().item() / 2, rel=1e-5)


def diagnosed(problem, agent):
    """Diagnostics of an agent that succeeds in half of four episodes of ten decisions."""
    obs = problem.batch(40, dtype=agent.dtype).obs.unflatten(0, (10, 4))
    noise, (drawn, log_prob) = (
        torch.stack([agent.act(o, deterministic=True) for o in obs]),
        (torch.stack(x) for x in zip(*map(agent.sample, obs), strict=True)),
    )
    yes = torch.ones(10, 4, dtype=torch.bool)
    terminal, last = torch.zeros_like(yes), torch.zeros_like(yes)
    terminal[9, :2], last[9, 2:] = True, True
    reward = -torch.ones(10, 4, dtype=agent.dtype)
    long = LongEpisodes(obs, drawn, log_prob, reward, terminal, last, yes, ~yes, False)
    greedy = Rollout({}, obs, noise, reward, obs, yes, terminal)
    played = Played(greedy, long, (-20.0, 0.0), torch.Generator().manual_seed(0))
    return agent.diagnostics(played), obs.flatten(0, 1), noise.flatten(0, 1)


@pytest.mark.parametrize("critic", ["noise", "aliased", "sampler"])
def test_a_learner_is_diagnosed_as_by_hand(problem, critic):
    agent = trained("standard", critic_kind=critic, soft_backup=True)
    found, obs, noise = diagnosed(problem, agent)
    q = agent.q_values(obs, noise)
    assert found["q_mean"] == pytest.approx(q.amin(0).mean().item())
    gap = (agent.noise_q_values(obs, noise) - q).abs().mean().item()
    assert found["alias_gap"] == (pytest.approx(gap) if critic == "aliased" else None)
    few = torch.randperm(40, generator=torch.Generator().manual_seed(0))
    random = agent.gaussian_noise(40, torch.Generator().manual_seed(0))
    gain = (q[:, few] - agent.q_values(obs[few], random)).mean().item()
    assert found["q_preference"] == pytest.approx(gain)
    assert found["alpha"] == agent.alpha.item()
    allowance = found["alpha"] * 0.95 / 0.05 * abs(found["entropy"])
    assert found["q_allowance"] == pytest.approx(allowance)
    assert found["mode_norm"] == pytest.approx(noise.flatten(1).norm(dim=1).mean().item())
    assert found["q_decisions"] == 40
    assert found["q_off_bias"] is None


def test_errors_of_symmetry_tell_the_agents_apart(problem):
    names = ("equivariant", "residual-pathway", "standard", "wrong-group")
    agents = (trained(n, **({"penalty": 100.0} if n == names[1] else {})) for n in names)
    strict, between, plain, wrong = (diagnosed(problem, agent)[0] for agent in agents)
    for key in ("equivariance_actor", "equivariance_critic"):
        assert strict[key] < 1e-10 < 1e-6 < between[key] < plain[key]
        assert min(plain[key], wrong[key]) > 0.1
    assert max(one["equivariance_decode"] for one in (strict, between, plain)) < 1e-10


def test_policy_statistics(problem):
    obs, agent = problem.batch(256).obs, problem.agent("equivariant", initial_alpha=0.2)
    quiet = diagnostics.policy_statistics(agent, obs)
    assert quiet["alpha"] == pytest.approx(0.2, rel=1e-5)
    assert quiet["mode_norm"] < 0.2
    mean, log_scale = agent.moments(obs)
    agent.moments = lambda obs: (10 * mean.exp(), log_scale)
    loud = diagnostics.policy_statistics(agent, obs)
    assert quiet["saturated"] < 0.05 < 0.9 < loud["saturated"]
    assert quiet["noise_norm"] < loud["noise_norm"]
