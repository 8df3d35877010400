"""The control with the wrong symmetry: exact under its own turns, wrong under the true ones."""

import pytest
import torch

from symsteer.agents import AGENTS
from symsteer.agents.diagnostics import actor_equivariance_error, orbit_variance
from symsteer.policies.geometry import Group

CRITICS = ["noise", "aliased", "sampler"]


def trained(problem, name="wrong-group", **options):
    agent = problem.agent(name, dtype=torch.float64, initial_output=1.0, **options)
    for seed in range(10):
        agent.update(problem.batch(seed=seed, dtype=torch.float64))
    return agent


def errors(problem, agent, sense):
    """Relative errors over C8 of w, its log-probability and Q, if w turns by ``sense * angle``."""
    batch = problem.batch(64, seed=5, dtype=torch.float64)
    act, chunk = problem.act_layout, agent.noise_layout
    eps = torch.randn(64, chunk.dim, generator=torch.Generator().manual_seed(6)).double()
    noise = 0.4 * batch.noise

    def quantities(obs, noise, eps):
        mean, log_scale = agent.moments(obs)
        sample, log_prob = agent.distribution.sample(mean, log_scale, eps)
        q = {"q": agent.q_values(obs, noise), "noise_q": agent.noise_q_values(obs, noise)}
        return {"mean": mean, "sample": sample, "log_prob": log_prob, **q}

    own = quantities(batch.obs, noise, eps)
    worst = dict.fromkeys(own, 0.0)
    for angle, _ in Group.parse("C8").elements:
        moved = quantities(
            problem.obs_layout.transform(batch.obs, angle),
            act.transform(noise, sense * angle),
            chunk.transform(eps, sense * angle),
        )
        for key, value in own.items():
            turns = key in ("mean", "sample")
            expected = chunk.transform(value, sense * angle) if turns else value
            error = (moved[key] - expected).abs().max() / value.abs().max()
            worst[key] = max(worst[key], error.item())
    return worst


@pytest.mark.parametrize("critic", CRITICS)
def test_it_is_exact_under_its_mirrored_action_and_wrong_under_the_true_one(problem, critic):
    agent = trained(problem, critic=critic)
    assert max(errors(problem, agent, -1).values()) < 1e-10
    assert min(errors(problem, agent, 1).values()) > 1e-2


def test_the_measured_errors_see_it(problem):
    group = Group.parse("C8")
    batch = problem.batch(64, dtype=torch.float64)
    for name, wrong in (("wrong-group", True), ("equivariant", False)):
        agent = trained(problem, name)
        error = actor_equivariance_error(agent, batch.obs, group)
        share = orbit_variance(agent, batch.obs, 0.4 * batch.noise, group)["orbit_share"]
        assert (error > 0.1, share > 0.1) == (wrong, wrong)
        if not wrong:
            assert max(error, share) < 1e-10


def test_it_is_a_control_and_as_large_as_the_equivariant_agent(problem):
    assert AGENTS.get("wrong-group").role == "control"
    for critic in CRITICS:
        sizes = [
            problem.agent(name, critic=critic).parameter_counts()
            for name in ("wrong-group", "equivariant")
        ]
        assert sizes[0] == sizes[1]
    shapes = [
        [p.shape for net in problem.agent(name).networks.values() for p in net.parameters()]
        for name in ("wrong-group", "equivariant")
    ]
    assert shapes[0] == shapes[1]
