"""The base policy's noise and the zero noise behind the agents' interface."""

import pytest
import torch

from symsteer.agents.episodes import Played, Rollout
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


@pytest.mark.parametrize("where", ["obs", "noise", "nowhere", "over"])
def test_base_says_whether_sides_are_alike(problem, where):
    """One side is pushed in what is seen, in what is done, or only after success."""
    shape, noise = (4, 60), problem.batch(240).noise.unflatten(0, (4, 60))
    obs, following = (problem.batch(240, seed).obs.unflatten(0, shape) for seed in (1, 2))
    running = torch.ones(shape, dtype=torch.bool)
    running[2:] = False
    shift = torch.zeros(problem.obs_layout.dim)
    shift[problem.obs_layout.slice("goal_xy")] = torch.tensor([1.0, 0.0])
    if where == "noise":
        noise[..., problem.act_layout.slice("xy")] += torch.tensor([1.0, 0.0])
    if where in ("obs", "over"):
        rows = running if where == "obs" else ~running
        obs, following = (x + rows[..., None] * shift for x in (obs, following))
    played = Rollout({}, obs, noise, torch.zeros(shape), following, running, ~running)
    agent, generator = problem.agent("base"), torch.Generator().manual_seed(0)
    found = agent.diagnostics(Played(played, None, (-1.0, 0.0), generator))
    assert set(found) == {"direction_p", "axis_p", "drift_x", "drift_y"}
    assert (found["direction_p"] <= 0.002) == (where in ("obs", "noise"))


def test_base_says_how_far_the_tool_drifts(problem):
    shape, noise = (4, 60), problem.batch(240).noise.unflatten(0, (4, 60))
    obs = problem.batch(240, 1).obs.unflatten(0, shape)
    agent, following = problem.agent("base"), obs.clone()
    done = agent.decode(obs.flatten(0, 1), noise.flatten(0, 1))[:, : agent.context.execute]
    moved = done[..., problem.act_layout.slice("xy")].sum(1).unflatten(0, shape)
    following[..., problem.obs_layout.slice("tcp_xy")] += moved + torch.tensor([0.1, -0.2])
    running = torch.ones(shape, dtype=torch.bool)
    played = Rollout({}, obs, noise, torch.zeros(shape), following, running, ~running)
    generator = torch.Generator().manual_seed(0)
    found = agent.diagnostics(Played(played, None, (-1.0, 0.0), generator))
    assert found["drift_x"] == pytest.approx(0.1, abs=1e-5)
    assert found["drift_y"] == pytest.approx(-0.2, abs=1e-5)


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
