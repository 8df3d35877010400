"""Layouts with every kind of irrep, random transitions, and how equivariant an agent is."""

import dataclasses
import functools
from dataclasses import fields

import pytest
import torch

from symsteer.agents import AGENTS
from symsteer.agents.agent import AgentContext
from symsteer.agents.replay import Batch, ReplayBuffer, Transition
from symsteer.policies.geometry import Field, Group, Layout
from symsteer.policies.normalizer import clip_blocks

OBS = Layout(
    [
        Field("tcp_xy", 1),
        Field("tcp_z", 0),
        Field("column", 1, odd=True),
        Field("rod", 2),
        Field("yaw", 0, odd=True),
        Field("goal_xy", 1),
    ]
)
ACT = Layout(
    [
        Field("xy", 1),
        Field("z", 0),
        Field("tilt", 1, odd=True),
        Field("yaw", 0, odd=True),
        Field("gripper", 0),
    ]
)
HORIZON = 3
# All that tuning may change, so that no test depends on what it chose.
SMALL = {
    "critics": 2,
    "reduce": "min",
    "utd": 1.0,
    "target_entropy": 0.0,
    "initial_alpha": 0.3,
    "noise_bound": 1.5,
    "distill": "mixture",
    "distill_steps": 1.0,
    "width": 32,
    "batch_size": 32,
    "lr": 1e-3,
    "alpha_lr": 1e-3,
    "tau": 0.005,
    "reward_scale": 1.0,
    "warmup": 0,
}
EXECUTE = 2
BANK = 4


@dataclasses.dataclass(frozen=True)
class Problem:
    obs_layout: Layout = OBS
    act_layout: Layout = ACT
    horizon: int = HORIZON
    options: dict = dataclasses.field(default_factory=lambda: SMALL, hash=False)

    def context(self, seed=0, dtype=torch.float32, normalize_obs=None, decode=None):
        return AgentContext(
            self.obs_layout,
            self.act_layout,
            self.horizon,
            EXECUTE,
            decode or (lambda obs, noise: clip_blocks(noise, self.act_layout, 1.0)),
            normalize_obs or (lambda obs: obs),
            seed=seed,
            dtype=dtype,
        )

    def agent(self, name, seed=0, dtype=torch.float32, normalize_obs=None, **options):
        agent = AGENTS.get(name)
        known = {field.name for field in dataclasses.fields(agent.Options)}
        shared = {key: value for key, value in self.options.items() if key in known}
        context = self.context(seed, dtype, normalize_obs)
        return agent(context, agent.Options(**{**shared, **options}))

    def shapes(self, rows=None):
        obs = (self.obs_layout.dim,)
        counts = (rows or self.horizon, EXECUTE)
        noise, actions = ((count, self.act_layout.dim) for count in counts)
        return {
            "obs": obs,
            "noise": noise,
            "actions": actions,
            "reward": (),
            "next_obs": obs,
            "terminal": (),
            "truncated": (),
            "bank_noise": (BANK, *noise),
            "bank_actions": (BANK, *actions),
        }

    def batch(self, size=32, seed=0, dtype=torch.float32, terminal=None, rows=None):
        g = torch.Generator().manual_seed(seed)

        def draw(*shape):
            return torch.randn(*shape, generator=g, dtype=torch.float64).to(dtype)

        ends = (torch.rand(size, generator=g) < 0.3).to(dtype)
        fields = {name: draw(size, *shape) for name, shape in self.shapes(rows).items()}
        fields["terminal"] = (
            ends if terminal is None else torch.full((size,), terminal, dtype=dtype)
        )
        fields["truncated"] = torch.zeros(size, dtype=dtype)
        return Batch(fields)

    def transition(self, size=32, seed=0, rows=None):
        batch = self.batch(size, seed, rows=rows)
        return Transition(**{field.name: batch[field.name] for field in fields(Transition)})

    def replay(self, size=128, seed=0, dtype=torch.float32):
        buffer = ReplayBuffer(1000, self.shapes(), seed=seed, dtype=dtype)
        buffer.add(self.batch(size, seed, dtype))
        return buffer


@pytest.fixture(scope="session")
def problem():
    return Problem()


DOUBLE = {"dtype": torch.float64, "initial_output": 1.0}
"""Options with which errors of symmetry are seen."""


def learn(problem, agent, updates=20):
    for seed in range(updates):
        agent.update(problem.batch(32, seed, agent.dtype, rows=agent.rows))
    return agent


@functools.cache
def trained(name, updates=20, dtype=torch.float64, **options):
    """An agent after some updates, the same one for all tests: do not change it."""
    problem = Problem()
    return learn(problem, problem.agent(name, dtype=dtype, initial_output=1.0, **options), updates)


def errors(agent, problem, name="C8", size=64, sense=1):
    """Relative errors over the group: mean, deterministic w, samples, log-probability, both Q.

    The true layouts are those of ``problem``; the agent may have other ones. Noise turns by
    ``sense`` times the angle of the scene.
    """
    batch = problem.batch(size, seed=5, dtype=agent.dtype)
    chunk = problem.act_layout.repeat(problem.horizon)
    generator = torch.Generator().manual_seed(6)
    eps = torch.randn(size, chunk.dim, generator=generator, dtype=torch.float64).to(agent.dtype)
    noise = 0.4 * batch.noise

    def quantities(obs, noise, eps):
        mean, log_scale = agent.moments(obs)
        sample, log_prob = agent.distribution.sample(mean, log_scale, eps)
        return {
            "mean": mean,
            "deterministic": agent.mode(obs).flatten(1),
            "sample": sample,
            "sample_log_prob": log_prob,
            "q": agent.q_values(obs, noise),
            "noise_q": agent.noise_q_values(obs, noise),
        }

    own = quantities(batch.obs, noise, eps)
    # A constant quantity would pass.
    assert own["mean"].norm(dim=1).min() > 1e-2
    assert min(own[key].std(dim=1).min() for key in ("q", "noise_q")) > 1e-3
    worst = dict.fromkeys(own, 0.0)
    for angle, reflect in Group.parse(name).elements:
        turn = (sense * angle, reflect)
        moved = quantities(
            problem.obs_layout.transform(batch.obs, angle, reflect),
            problem.act_layout.transform(noise, *turn),
            chunk.transform(eps, *turn),
        )
        for key, value in own.items():
            turns = key in ("mean", "deterministic", "sample")
            expected = chunk.transform(value, *turn) if turns else value
            error = (moved[key] - expected).abs().max() / value.abs().max()
            worst[key] = max(worst[key], error.item())
    return worst
