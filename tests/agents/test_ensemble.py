"""Plain networks averaged over the group are equivariant; the regularisers make copies agree."""

import pytest
import torch
from torch.distributions import Normal, kl_divergence

from symsteer.policies.geometry import Group, equivariance_error, group_average
from tests.agents.conftest import ACT, DOUBLE, OBS, trained


def test_with_the_trivial_group_it_is_the_standard_agent(problem):
    obs = problem.batch(dtype=torch.float64).obs
    standard, ensemble = trained("standard"), trained("ensemble", group="C1")
    torch.testing.assert_close(standard.mode(obs), ensemble.mode(obs))


def test_the_divergence_is_that_of_gaussians(problem):
    agent = problem.agent("ensemble", **DOUBLE)
    generator = torch.Generator().manual_seed(0)
    outputs, others = torch.randn(
        2, 5, agent.actor_layout.dim, generator=generator, dtype=torch.float64
    )
    found = agent._divergence(outputs, others)
    first, second = (
        Normal(mean, agent.distribution.spread(log_scale.exp()))
        for mean, log_scale in map(agent.distribution.parameters_of, (outputs, others))
    )
    expected = kl_divergence(first, second) + kl_divergence(second, first)
    torch.testing.assert_close(found, expected.sum(-1))


@pytest.mark.parametrize("name", ["actor", "critic"])
def test_the_regularisers_make_the_copies_agree(problem, name):
    """The ratio of their size with and without."""
    sizes = []
    batch = problem.batch(64, seed=99, dtype=torch.float64)
    for weight in (0.0, 10.0):
        options = {
            "actor_regularizer": 0.0,
            "critic_regularizer": 0.0,
            f"{name}_regularizer": weight,
        }
        agent = trained("ensemble", 60, **options)
        measured = problem.agent("ensemble", **{**options, f"{name}_regularizer": 1.0}, **DOUBLE)
        measured.load_state_dict(agent.state_dict())
        sizes.append(measured.penalty(name, batch).item())
    without, with_it = sizes
    assert with_it < 0.5 * without


def test_any_function_can_be_averaged():
    torch.manual_seed(0)
    network = torch.nn.Sequential(
        torch.nn.Linear(OBS.dim, 32), torch.nn.Tanh(), torch.nn.Linear(32, ACT.dim)
    ).double()
    obs = torch.randn(16, OBS.dim, dtype=torch.float64)
    for name in ("C8", "D4"):
        group = Group.parse(name)

        def averaged(x, group=group):
            return group_average(network, (x,), (OBS,), ACT, group)

        assert equivariance_error(network, (obs,), (OBS,), ACT, group) > 1e-2
        assert equivariance_error(averaged, (obs,), (OBS,), ACT, group) < 1e-10
