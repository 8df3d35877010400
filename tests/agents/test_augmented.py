"""Batches that are turned as a whole teach a plain agent the symmetry."""

import math

import pytest
import torch

from symsteer.agents import AGENTS
from symsteer.agents.agent import AgentContext
from symsteer.agents.diagnostics import orbit_variance
from symsteer.agents.replay import Transition
from symsteer.agents.standard import StandardAgent
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
        """Variance of Q over orbits, over that of Q, for both kinds of critics."""
        kind = AGENTS.get(name)
        agent = kind(context, kind.Options(width=32, batch_size=64, lr=3e-3, gamma=0.0, warmup=0))
        agent.observe(Transition(obs, noise, noise, reward, obs, **ends))
        for _ in range(300):
            agent.update(agent.replay.sample(64))
        for q_values in (agent.q_values, agent.noise_q_values):
            agent.q_values = q_values
            within = orbit_variance(agent, obs, noise, Group.parse("C8"))
            yield within / q_values(obs, noise).var(1).mean().item()

    for augmented, standard in zip(shares("augmented"), shares("standard"), strict=True):
        assert augmented < 0.5 * standard


@pytest.mark.parametrize(("group", "images"), [("C8", 8), ("D4", 8), ("C1", 1)])
def test_each_row_is_turned_as_a_whole_and_anew(problem, monkeypatch, group, images):
    """Every vector of a row, in observations, noise, actions and bank, by one symmetry."""
    seen = []
    monkeypatch.setattr(StandardAgent, "learn", lambda self, batch, _: seen.append(batch) or {})
    batch = problem.batch(96, dtype=torch.float64)
    for seed in (0, 0):
        agent = problem.agent("augmented", seed, group=group, dtype=torch.float64)
        fields = agent.vector_fields
        for name in fields:  # every row the same one, so that rows differ by their symmetries only
            batch[name] = batch[name][:1].expand_as(batch[name])
        for _ in range(2):
            agent.update(batch)
    turned, later, again, _ = seen
    assert torch.equal(turned.obs, again.obs)
    assert torch.equal(turned.obs, later.obs) == (group == "C1")
    assert set(batch) - set(fields) == {"reward", "terminal", "truncated"}
    for name in set(batch) - set(fields):
        assert torch.equal(turned[name], batch[name])
    obs = problem.obs_layout
    directions = turned.obs[:, obs.slice("tcp_xy")], batch.obs[:, obs.slice("tcp_xy")]
    angles = [torch.atan2(xy[:, 1], xy[:, 0]) for xy in directions]
    reflect = turned.obs[:, obs.slice("yaw")].sign() != batch.obs[:, obs.slice("yaw")].sign()
    for row in range(96):
        start = -angles[1][row] if reflect[row] else angles[1][row]
        angle = (angles[0][row] - start).item()
        steps = angle / (2 * math.pi) * Group.parse(group).rotations
        assert abs(steps - round(steps)) < 1e-9
        for name, layout in fields.items():
            expected = layout.transform(batch[name][row], angle, bool(reflect[row]))
            torch.testing.assert_close(turned[name][row], expected)
    assert bool(reflect.any()) == (group == "D4")
    assert len(turned.obs.round(decimals=9).unique(dim=0)) == images
