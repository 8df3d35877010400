"""Orbit targets: the posterior mean, the same gradient on average, less variance."""

import math

import pytest
import torch

from symsteer.errors import UserError
from symsteer.policies.geometry import Group
from symsteer.policies.training.orbit import orbit_targets


def test_the_target_is_the_mean_of_the_copies_that_a_noisy_pair_may_come_from(world):
    """By Bayes' rule, one row and one copy at a time."""
    group, layouts = Group.parse("D4"), (world.obs_layout, world.act_layout)
    generator = torch.Generator().manual_seed(0)
    obs = world.observations(5).double()
    chunks = torch.randn(5, 3, world.act_layout.dim, generator=generator).double()
    keep, spread = torch.rand(2, 5, 1, 1, generator=generator).double()
    seen = obs + 0.7 * torch.randn(obs.shape, generator=generator)
    noisy = keep * chunks + spread * torch.randn(chunks.shape, generator=generator)
    found = orbit_targets(((obs, seen, 1.0, 0.7), (chunks, noisy, keep, spread)), layouts, group)
    for row in range(5):
        weights, copies = [], []
        for angle, reflect in group.elements:
            turned = layouts[0].transform(obs[row], angle, reflect)
            copies.append(layouts[1].transform(chunks[row], angle, reflect))
            far = ((seen[row] - turned) / 0.7).square().sum()
            far += ((noisy[row] - keep[row] * copies[-1]) / spread[row]).square().sum()
            weights.append(math.exp(-0.5 * far))
        mean = sum(w * c for w, c in zip(weights, copies, strict=True)) / sum(weights)
        assert torch.allclose(found[row], mean, atol=1e-10)


def test_a_precise_observation_leaves_the_pair_itself(world):
    obs, chunks = world.observations(4), torch.randn(4, 2, world.act_layout.dim)
    pairs = ((obs, obs, 1.0, 1e-3), (chunks, torch.zeros_like(chunks), 0.0, 1.0))
    layouts = (world.obs_layout, world.act_layout)
    assert torch.allclose(orbit_targets(pairs, layouts, Group.parse("C8")), chunks, atol=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("fields", [{}, {"process": "flow", "prediction": "velocity"}])
def test_the_gradient_is_the_same_on_average_and_varies_less(world, fields):
    """The part of the gradient that turns: invariant numbers have one target in any case."""
    (obs, actions), *_ = world.episodes(1, length=8)
    turning = ~world.act_layout.repeat(8).invariant_mask()
    pair = obs[:1], actions[None, :8]
    gradients = {}
    for orbit in (False, True):
        policy = world.untrained(observation_noise=4.0, orbit_targets=orbit, **fields)
        policy.requires_grad_(True)
        parameter = policy.denoiser.project.weight
        rows = []
        generator = torch.Generator().manual_seed(int(orbit))
        for _ in range(600):
            loss = policy.loss(*(x.repeat(8, *(1,) * (x.dim() - 1)) for x in pair), generator)
            rows.append(torch.autograd.grad(loss, parameter)[0][turning].flatten())
        gradients[orbit] = torch.stack(rows)
    means = {orbit: rows.mean(0) for orbit, rows in gradients.items()}
    variances = {orbit: rows.var(0).sum() for orbit, rows in gradients.items()}
    error = ((variances[False] + variances[True]) / 600).sqrt()
    assert (means[True] - means[False]).norm() < 1.5 * error
    assert means[False].norm() > 5 * error
    assert variances[True] < 0.9 * variances[False]


def test_a_plain_network_has_no_orbit(world):
    for name in ("plain", "canonical"):
        with pytest.raises(UserError, match="need a group"):
            world.untrained(name, orbit_targets=True, observation_noise=0.1)
    assert world.untrained("plain-augmented", orbit_targets=True, observation_noise=0.1)
