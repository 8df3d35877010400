"""Batches that are turned as a whole teach a plain agent the symmetry."""

import math

import pytest
import torch

from symsteer.agents import AGENTS
from symsteer.agents.agent import AgentContext
from symsteer.agents.diagnostics import orbit_variance
from symsteer.agents.replay import Transition
from symsteer.agents.standard import StandardAgent
from symsteer.errors import UserError
from symsteer.policies.geometry import Field, Group, Layout

OBS = Layout([Field("object_xy", 1), Field("height", 0), Field("column", 1, odd=True)])
ACT = Layout([Field("xy", 1), Field("z", 0)])


def test_turned_batches_teach_the_critics_the_symmetry():
    """On an invariant reward that the data show from one side only."""
    context = AgentContext(OBS, ACT, 2, 2, lambda obs, noise: noise, lambda obs: obs)
    generator = torch.Generator().manual_seed(0)
    size = 512
    obs = torch.randn(size, OBS.dim, generator=generator)
    obs[:, 0] = obs[:, 0].abs()
    noise = torch.rand(size, 2, ACT.dim, generator=generator) - 0.5
    reward = -(obs[:, :2] - noise[:, 0, :2]).square().sum(1)
    ends = {"terminal": torch.ones(size), "truncated": torch.zeros(size)}

    def shares(name):
        kind = AGENTS.get(name)
        agent = kind(context, kind.Options(width=32, batch_size=64, lr=3e-3, gamma=0.0, warmup=0))
        agent.observe(Transition(obs, noise, noise, reward, obs, **ends))
        for _ in range(300):
            agent.update(agent.replay.sample(64, agent.options.gamma))
        of_actions = orbit_variance(agent, obs, noise, Group.parse("C8"))["orbit_share"]
        agent.q_values = agent.noise_q_values
        of_noise = orbit_variance(agent, obs, noise, Group.parse("C8"))["orbit_share"]
        return of_actions, of_noise

    for augmented, standard in zip(shares("augmented"), shares("standard"), strict=True):
        assert augmented < 0.5 * standard


@pytest.mark.parametrize(("group", "images"), [("C8", 8), ("D4", 8), ("C1", 1), ("SO2", 96)])
def test_each_row_is_turned_as_a_whole(problem, monkeypatch, group, images):
    """Every vector of a row, in observations, noise, actions and bank, by one symmetry."""
    seen = []
    monkeypatch.setattr(StandardAgent, "learn", lambda self, batch: seen.append(batch) or {})
    agent = problem.agent("augmented", augmentation=group, dtype=torch.float64)
    batch = problem.batch(96, dtype=torch.float64)
    fields = agent.vector_fields
    assert set(batch) - set(fields) == {"reward", "terminal", "truncated", "discount"}
    for name in fields:  # every row the same one, so that rows differ by their symmetries only
        batch[name] = batch[name][:1].expand_as(batch[name])
    agent.update(batch)
    (turned,) = seen
    for name in set(batch) - set(fields):
        assert torch.equal(turned[name], batch[name])
    obs = problem.obs_layout
    directions = turned.obs[:, obs.slice("tcp_xy")], batch.obs[:, obs.slice("tcp_xy")]
    angles = [torch.atan2(xy[:, 1], xy[:, 0]) for xy in directions]
    reflect = turned.obs[:, obs.slice("yaw")].sign() != batch.obs[:, obs.slice("yaw")].sign()
    for row in range(96):
        start = -angles[1][row] if reflect[row] else angles[1][row]
        angle = (angles[0][row] - start).item()
        if group != "SO2":
            steps = angle / (2 * math.pi) * Group.parse(group).rotations
            assert abs(steps - round(steps)) < 1e-9
        for name, layout in fields.items():
            expected = layout.transform(batch[name][row], angle, bool(reflect[row]))
            torch.testing.assert_close(turned[name][row], expected)
    assert bool(reflect.any()) == (group == "D4")
    assert len(turned.obs.round(decimals=9).unique(dim=0)) == images


def test_batches_are_turned_anew_and_alike_for_a_seed(problem, monkeypatch):
    seen = []
    monkeypatch.setattr(StandardAgent, "learn", lambda self, batch: seen.append(batch.obs) or {})
    for seed in (0, 0, 1):
        agent = problem.agent("augmented", seed=seed)
        for _ in range(2):
            agent.update(problem.batch())
    first, second, again, _, other, _ = seen
    assert not torch.equal(first, second)
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


@pytest.mark.parametrize("group", ["D4", "SO2"])
def test_it_learns_with_other_groups(problem, group):
    agent = problem.agent("augmented", augmentation=group)
    for seed in range(3):
        scalars = agent.update(problem.batch(seed=seed))
        assert all(torch.isfinite(value) for value in scalars.values())


def test_unknown_groups_are_refused(problem):
    with pytest.raises(UserError, match="X8"):
        problem.agent("augmented", augmentation="X8")
