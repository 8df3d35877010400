"""Every diagnostic against a case whose answer is known."""

import math
from types import SimpleNamespace

import pytest
import torch

from symsteer.agents import diagnostics
from symsteer.policies.geometry import Group
from tests.agents.test_equivariance import trained

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
    found = diagnostics.discounted_returns(reward, ends, last, 0.5, bonus)
    # The last decision, with -1 and a bonus of 0.25, goes on for ever.
    third = -1 + 0.5 * 2 * (-1 + 0.25)
    second = -1 + 0.5 * (third + 0.25)
    assert found[:, 0].tolist() == [-1 + 0.5 * (-0.875 + 0.5), -1 + 0.5 * 0.25, 0.0]
    assert found[:, 1].tolist() == [-1 + 0.5 * (second + 0.5), second, third]
    assert found[:2, 2].tolist() == [-1 + 0.5 * 0.5, 0.0]


def test_agreement_by_hand():
    q = torch.tensor([1.0, 2.0, 3.0, 9.0] * 2, dtype=torch.float64)
    returns = torch.tensor([2.0, 1.0, 4.0, 5.0] * 2, dtype=torch.float64)
    found = diagnostics.agreement(q, returns)
    assert found["bias"] == 0.75
    assert found["bias_std"] == pytest.approx(
        torch.tensor([-1.75, 0.25, -1.75, 3.25]).std(unbiased=False)
    )
    assert found["correlation"] == pytest.approx(16 / (38.75 * 10) ** 0.5)
    assert found["rank_correlation"] == pytest.approx(0.8)
    assert found["overestimated"] == 0.5
    assert found["decisions"] == 8
    few = diagnostics.agreement(q[:7], returns[:7])
    assert few["correlation"] is few["rank_correlation"] is None
    assert few["bias"] is not None
    nothing = diagnostics.agreement(q[:0], q[:0])
    assert nothing.pop("decisions") == 0
    assert set(nothing.values()) == {None}


def test_orbit_variance_and_actor_error_tell_the_agents_apart(problem):
    batch = problem.batch(64)
    results = {}
    for name in ("equivariant", "residual-pathway", "standard"):
        held = {"penalty": 100.0} if name == "residual-pathway" else {}
        agent = trained(problem, problem.agent(name, initial_output=1.0, **held), torch.float32)
        orbit = diagnostics.orbit_variance(agent, batch.obs, batch.noise, C8)
        error = diagnostics.actor_equivariance_error(agent, batch.obs, C8)
        results[name] = (orbit["orbit_share"], error)
    assert results["equivariant"][0] < 1e-9
    assert results["equivariant"][1] < 1e-5
    assert 1e-6 < results["residual-pathway"][0] < 0.2
    assert 1e-4 < results["residual-pathway"][1] < 0.2
    assert min(results["standard"]) > 0.2


def test_orbit_variance_is_the_variance_over_the_orbit(problem):
    class Linear:
        obs_layout, act_layout = problem.obs_layout, problem.act_layout

        def q_values(self, obs, noise):
            return obs[:, problem.obs_layout.slice("tcp_xy")][:, 0][None]

    batch = problem.batch(16)
    report = diagnostics.orbit_variance(Linear(), batch.obs, batch.noise, C8)
    radius2 = batch.obs[:, problem.obs_layout.slice("tcp_xy")].square().sum(1)
    assert report["orbit_variance"] == pytest.approx(radius2.mean().item() / 2, rel=1e-5)


def test_alias_gap_is_the_mean_error_of_the_distilled_critics(problem):
    class Known:
        options = SimpleNamespace(critic="aliased")

        def q_values(self, obs, noise):
            return obs[:, 0].expand(2, -1)

        def noise_q_values(self, obs, noise):
            return self.q_values(obs, noise) + torch.tensor([[1.0], [-3.0]])

    batch = problem.batch()
    assert diagnostics.alias_gap(Known(), batch.obs, batch.noise) == pytest.approx(2.0)
    for critic in ("noise", "sampler"):
        agent = problem.agent("standard", critic=critic)
        assert diagnostics.alias_gap(agent, batch.obs, batch.noise) is None


@pytest.mark.parametrize("critic", ["noise", "aliased", "sampler"])
def test_critic_preference_grows_as_the_actor_follows_the_critic(problem, critic):
    agent = problem.agent("standard", initial_alpha=1e-6, critic=critic)
    agent.optimizers["critic"].param_groups[0]["lr"] = 0.0
    obs = problem.batch(256).obs

    def preference():
        generator = torch.Generator().manual_seed(0)
        return diagnostics.critic_preference(agent, obs, generator)["critic_preference"]

    before = preference()
    for seed in range(60):
        agent.update(problem.batch(seed=seed))
    assert preference() > before + 1e-3


def test_policy_statistics(problem):
    obs = problem.batch(256).obs
    agent = problem.agent("equivariant", initial_scale=0.01, initial_alpha=0.2)
    quiet = diagnostics.policy_statistics(agent, obs)
    loud = diagnostics.policy_statistics(problem.agent("equivariant", initial_scale=2.5), obs)
    assert quiet["alpha"] == pytest.approx(0.2, rel=1e-5)
    assert quiet["saturated_share"] == 0.0
    assert loud["saturated_share"] > 0.2
    assert quiet["entropy"] < loud["entropy"]
    assert quiet["noise_norm"] < loud["noise_norm"]
    assert quiet["mode_norm"] < 0.2
