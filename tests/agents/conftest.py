"""Layouts with every kind of irrep, random transitions, and a bandit with a known best noise."""

import dataclasses

import pytest
import torch

from symsteer.agents import Batch, ReplayBuffer, SacConfig, make_agent
from symsteer.policies.geometry import Field, Layout

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
SMALL = SacConfig(width=32, batch_size=32, lr=1e-3, alpha_lr=1e-3)


@dataclasses.dataclass(frozen=True)
class Problem:
    obs_layout: Layout = OBS
    act_layout: Layout = ACT
    horizon: int = HORIZON
    config: SacConfig = SMALL

    def agent(self, name, seed=0, dtype=torch.float32, normalize_obs=None, **options):
        config = dataclasses.replace(self.config, **options)
        return make_agent(
            name,
            self.obs_layout,
            self.act_layout,
            self.horizon,
            config,
            seed=seed,
            dtype=dtype,
            normalize_obs=normalize_obs,
        )

    def batch(self, size=32, seed=0, dtype=torch.float32, terminal=None):
        g = torch.Generator().manual_seed(seed)

        def draw(*shape):
            return torch.randn(*shape, generator=g, dtype=torch.float64).to(dtype)

        ends = (torch.rand(size, generator=g) < 0.3).to(dtype)
        return Batch(
            draw(size, self.obs_layout.dim),
            draw(size, self.horizon, self.act_layout.dim),
            draw(size),
            draw(size, self.obs_layout.dim),
            ends if terminal is None else torch.full((size,), terminal, dtype=dtype),
        )

    def replay(self, size=128, seed=0, dtype=torch.float32):
        buffer = ReplayBuffer(
            1000, self.obs_layout.dim, self.horizon, self.act_layout.dim, seed=seed, dtype=dtype
        )
        buffer.add(*self.batch(size, seed, dtype))
        return buffer


@pytest.fixture
def problem():
    return Problem()
