"""The base policy's noise and the zero noise behind the agents' interface."""

import pytest
import torch

from symsteer.errors import UserError


def test_base_is_seeded_standard_noise(problem):
    obs = problem.batch(4000).obs
    agent = problem.agent("base", seed=1)
    noise = agent.act(obs, deterministic=True)
    assert noise.shape == (4000, problem.horizon, problem.act_layout.dim)
    assert noise.mean().abs() < 0.02
    assert noise.std().item() == pytest.approx(1.0, abs=0.02)
    assert torch.equal(noise, problem.agent("base", seed=1).act(obs))
    assert not torch.equal(noise, problem.agent("base", seed=2).act(obs))


def test_zero_is_fixed_by_the_group(problem):
    noise = problem.agent("zero").act(problem.batch().obs)
    assert noise.shape == (32, problem.horizon, problem.act_layout.dim)
    assert torch.equal(
        problem.act_layout.transform(noise, 0.7, True).abs(), torch.zeros_like(noise)
    )


@pytest.mark.parametrize("name", ["base", "zero", "golden-ticket"])
def test_references_share_the_interface(problem, name):
    agent = problem.agent(name)
    assert agent.role == "reference"
    assert list(agent.batches()) == []
    assert agent.update(problem.batch()) == {}
    assert agent.parameter_counts()["total"] == 0
    agent.act(problem.batch().obs)
    other = problem.agent(name, seed=9)
    other.load_state_dict(agent.state_dict())
    assert torch.equal(agent.act(problem.batch().obs), other.act(problem.batch().obs))
    with pytest.raises(UserError, match="agent"):
        problem.agent("zero" if name == "base" else "base").load_state_dict(agent.state_dict())
