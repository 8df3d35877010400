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
    assert not agent.learns
    assert agent.update(problem.batch()) == {}
    assert agent.parameter_counts()["total"] == 0
    agent.act(problem.batch().obs)
    other = problem.agent(name, seed=9)
    other.load_state_dict(agent.state_dict())
    assert torch.equal(agent.act(problem.batch().obs), other.act(problem.batch().obs))
    with pytest.raises(UserError, match="agent"):
        problem.agent("zero" if name == "base" else "base").load_state_dict(agent.state_dict())


def test_a_golden_ticket_is_one_noise_for_all_states(problem):
    agent = problem.agent("golden-ticket", seed=1)
    obs = problem.batch().obs
    assert agent.searches
    assert not agent.act(obs).any()
    candidates = agent.candidates(2000)
    assert not candidates[0].any()
    assert candidates[1:].std().item() == pytest.approx(1.0, abs=0.02)
    agent.ticket, agent.searched = candidates[5], {"ticket_success": 0.5}
    assert torch.equal(agent.act(obs), candidates[5].expand(32, -1, -1))
    other = problem.agent("golden-ticket", seed=9)
    other.load_state_dict(agent.state_dict())
    assert torch.equal(other.act(obs), agent.act(obs))
    assert other.scalars() == agent.scalars()
    assert agent.scalars()["ticket_rms"] == pytest.approx(
        candidates[5].square().mean().sqrt().item()
    )
