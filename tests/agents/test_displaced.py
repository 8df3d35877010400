"""The displaced agent stays near the base policy's noise and climbs Q as far as it may."""

import pytest
import torch

from tests.agents.test_known_values import best, play, reach, states
from tests.marks import slow_except


def test_it_starts_as_the_base_policy(problem):
    agent = problem.agent("displaced", dtype=torch.float64)
    batch = problem.batch(256, dtype=torch.float64)
    noise = agent.act(batch.obs, deterministic=True)
    assert noise.std() == pytest.approx(1, abs=0.05)
    assert agent.mode(batch.obs).abs().max() < 0.05
    again = agent.act(batch.obs, deterministic=True)
    assert not torch.equal(noise, again)
    shift = agent.mode(batch.obs).flatten(1)
    _, price = agent.sample(batch.obs)
    torch.testing.assert_close(price, shift.square().sum(1))


@pytest.mark.long
@pytest.mark.parametrize("displacement", slow_except([0.05, 0.5], 0.5))
def test_the_multiplier_keeps_the_mean_displacement(displacement):
    """A plain climb of Q would go farther: see the next test."""
    agent = reach("displaced", displacement=displacement, initial_alpha=0.1, alpha_lr=0.03)
    obs = states(1024, torch.Generator().manual_seed(2))
    size = agent.mode(obs).square().mean().item()
    assert size == pytest.approx(displacement, rel=0.4)


@pytest.mark.long
def test_with_a_large_displacement_its_mean_is_almost_the_best():
    agent = reach("displaced", displacement=4.0)
    obs = states(1024, torch.Generator().manual_seed(2))
    way = play(obs, lambda obs: agent.executed(obs, agent.alternatives()["mean"](obs)))
    assert way.mean() > best(obs).mean() - 0.15
