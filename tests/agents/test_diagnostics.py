"""Every diagnostic against a case whose answer is known."""

import math

import pytest
import torch

from symsteer.agents import diagnostics
from symsteer.errors import UserError
from symsteer.policies.geometry import Group

GAMMA = 0.9
C8 = Group.parse("C8")


def test_bound_violation_counts_what_is_outside():
    q = torch.tensor([[-25.0, -20.0, -3.0, 0.0], [0.1, 5.0, -1.0, -2.0]])
    report = diagnostics.bound_violation(q, -20.0, 0.0)
    assert report["violation_share"] == pytest.approx(3 / 8)
    assert report["max_abs_q"] == 25.0
    assert report["finite"] == 1.0
    q[0, 1] = math.nan
    report = diagnostics.bound_violation(q, -20.0, 0.0)
    assert report["violation_share"] == pytest.approx(4 / 8)
    assert report["finite"] == 0.0


def episode_arrays(columns):
    """Reward, terminal, truncated ``[T, N]``; '.' goes on, 's' is success, 't' a time-out."""
    steps = torch.tensor([[".st".index(c) for c in column] for column in columns]).T
    reward = torch.where(steps == 1, 0.0, -1.0).double()
    return reward, (steps == 1).double(), (steps == 2).double()


def test_bias_of_exact_values_is_zero():
    """Episodes that succeed have exact returns; Q equal to them has no bias."""
    reward, terminal, truncated = episode_arrays(["..s", ".s.", "s.."])
    exact = torch.tensor(
        [[-1 - GAMMA, -1.0, 0.0], [-1.0, 0.0, math.nan], [0.0, math.nan, math.nan]],
        dtype=torch.float64,
    )
    # The unfinished rest of columns two and three is cut by the end of the record.
    q = torch.nan_to_num(exact)
    report = diagnostics.q_bias(q, reward, terminal, truncated, GAMMA, (-10.0, 0.0))
    assert report["bias_mean"] == pytest.approx(0.0, abs=1e-12)
    assert report["bias_std"] == pytest.approx(0.0, abs=1e-12)
    assert report["covered_share"] == pytest.approx(6 / 9)
    shifted = diagnostics.q_bias(q + 2.0, reward, terminal, truncated, GAMMA, (-10.0, 0.0))
    assert shifted["bias_mean"] == pytest.approx(2.0)
    covered_mean = (-1 - GAMMA - 1 - 1) / 6
    assert shifted["bias_normalized"] == pytest.approx(2.0 / abs(covered_mean))


def test_a_time_out_neither_counts_as_success_nor_is_guessed():
    """An agent that never succeeds has Q = -1/(1 - gamma); a cut return is consistent with it."""
    reward, terminal, truncated = episode_arrays(["...t" * 2])
    q = torch.full_like(reward, -1 / (1 - GAMMA))
    low_high = (-1 / (1 - GAMMA), 0.0)
    report = diagnostics.q_bias(q, reward, terminal, truncated, GAMMA, low_high)
    assert report["covered_share"] == 0.0
    assert math.isnan(report["bias_mean"])
    assert report["bias_low"] <= 1e-9 <= report["bias_high"] + 2e-9
    assert report["bias_high"] == pytest.approx(0.0, abs=1e-9)
    assert report["bias_low"] < -5
    # With a success instead, this Q would be wrong.
    reward, terminal, truncated = episode_arrays(["...s" * 2])
    report = diagnostics.q_bias(q, reward, terminal, truncated, GAMMA, low_high)
    assert report["bias_mean"] < -5
    # Far from the cut, the tail has a small weight and the state is covered.
    reward, terminal, truncated = episode_arrays(["." * 59 + "t"])
    q = torch.full_like(reward, -1 / (1 - GAMMA))
    report = diagnostics.q_bias(q, reward, terminal, truncated, GAMMA, low_high)
    assert 0.4 < report["covered_share"] < 0.6
    assert abs(report["bias_mean"]) < 0.05 * 10


def test_returns_do_not_leak_across_episodes():
    reward, terminal, truncated = episode_arrays(["s..s", "t..s"])
    q = torch.zeros_like(reward)
    report = diagnostics.q_bias(q, reward, terminal, truncated, GAMMA, (-10.0, 0.0))
    first = [0.0, -1.0]  # return of row 0: success at once; cut after one step
    rest = 2 * (-1 - GAMMA - 1.0)
    assert report["return_mean"] == pytest.approx((sum(first) + rest) / 8)
    assert report["covered_share"] == pytest.approx(7 / 8)


def test_soft_bias_adds_the_later_entropy():
    reward, terminal, truncated = episode_arrays(["..s"])
    log_prob = torch.tensor([[5.0], [-2.0], [-3.0]]).double()
    alpha = 0.1
    soft = [
        -1 + GAMMA * (-1 + GAMMA * 0.3 + 0.2),
        -1 + GAMMA * 0.3,
        0.0,
    ]
    q = torch.tensor(soft, dtype=torch.float64)[:, None]
    report = diagnostics.q_bias(
        q, reward, terminal, truncated, GAMMA, (-10.0, 0.0), log_prob=log_prob, alpha=alpha
    )
    assert report["soft_bias_mean"] == pytest.approx(0.0, abs=1e-12)
    assert report["soft_bias_std"] == pytest.approx(0.0, abs=1e-12)
    assert report["bias_mean"] > 0.1


def test_bias_refuses_unequal_shapes():
    with pytest.raises(UserError, match="one shape"):
        diagnostics.q_bias(torch.zeros(3, 2), *[torch.zeros(3, 1)] * 3, GAMMA, (-1.0, 0.0))


def test_orbit_variance_and_actor_error_tell_the_agents_apart(problem):
    batch = problem.batch(64)
    results = {}
    for name in ("equivariant", "approximate", "standard"):
        agent = problem.agent(name, initial_output=1.0)
        orbit = diagnostics.orbit_variance(agent, batch.obs, batch.noise, C8)
        error = diagnostics.actor_equivariance_error(agent, batch.obs, C8)
        results[name] = (orbit["orbit_share"], error)
    assert results["equivariant"][0] < 1e-9
    assert results["equivariant"][1] < 1e-5
    assert 1e-6 < results["approximate"][0] < 0.2
    assert 1e-4 < results["approximate"][1] < 0.2
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


def test_critic_preference_grows_as_the_actor_follows_the_critic(problem):
    agent = problem.agent("standard", initial_alpha=1e-6)
    agent.critic_optimizer.param_groups[0]["lr"] = 0.0
    obs = problem.batch(256).obs

    def preference():
        generator = torch.Generator().manual_seed(0)
        return diagnostics.critic_preference(agent, obs, generator)["critic_preference"]

    before = preference()
    for seed in range(30):
        agent.update(problem.batch(seed=seed))
    assert preference() > before + 1e-3


def test_policy_statistics(problem):
    obs = problem.batch(256).obs
    quiet = diagnostics.policy_statistics(problem.agent("equivariant", initial_scale=0.01), obs)
    loud = diagnostics.policy_statistics(problem.agent("equivariant", initial_scale=2.5), obs)
    assert quiet["alpha"] == pytest.approx(0.01, rel=1e-5)
    assert quiet["saturated_share"] == 0.0
    assert loud["saturated_share"] > 0.2
    assert quiet["entropy"] < loud["entropy"]
    assert quiet["noise_norm"] < loud["noise_norm"]
    assert quiet["mode_norm"] < 0.2
