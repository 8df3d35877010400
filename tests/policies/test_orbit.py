"""Orbit targets: the posterior mean; the same gradient on average, with less variance."""

import math

import pytest
import torch

from symsteer.errors import UserError
from symsteer.policies.geometry import Group
from symsteer.policies.training.orbit import orbit_targets
from tests.policies.conftest import ACT, OBS, make_episodes, observations, small_options, untrained
from tools import gradient_variance


def test_the_target_is_the_mean_of_the_copies_that_a_noisy_pair_may_come_from():
    """By Bayes' rule, one row and one copy at a time."""
    group, generator = Group.parse("D4"), torch.Generator().manual_seed(0)
    obs = observations(5).double()
    chunks = torch.randn(5, 3, ACT.dim, generator=generator).double()
    keep, spread = torch.rand(2, 5, 1, 1, generator=generator).double()
    seen = obs + 0.7 * torch.randn(obs.shape, generator=generator)
    noisy = keep * chunks + spread * torch.randn(chunks.shape, generator=generator)
    pairs = ((obs, seen, 1.0, 0.7), (chunks, noisy, keep, spread))
    targets = orbit_targets(pairs, (OBS, ACT), group)
    for row in range(5):
        weights, copies = [], []
        for element in group.elements:
            copies.append(ACT.transform(chunks[row], *element))
            far = ((seen[row] - OBS.transform(obs[row], *element)) / 0.7).square().sum()
            far += ((noisy[row] - keep[row] * copies[-1]) / spread[row]).square().sum()
            weights.append(math.exp(-0.5 * far))
        mean = sum(w * c for w, c in zip(weights, copies, strict=True)) / sum(weights)
        assert torch.allclose(targets[row], mean, atol=1e-10)


@pytest.mark.parametrize("fields", [{}, {"process": "flow", "prediction": "velocity"}])
def test_the_gradient_is_the_same_on_average_and_varies_less(fields):
    """On the same batches, as `python -m tools.gradient_variance` measures it."""
    options = [
        small_options(steps=3, batch_size=16, observation_noise=deviation, **fields)
        for deviation in (1e-3, 4.0)
    ]
    precise, noisy = (
        gradient_variance.measure("edp", one, make_episodes(2), (OBS, ACT), 0, 60)
        for one in options
    )
    # Precise observations leave each pair its own target.
    assert precise["orbit"] == pytest.approx(precise["own"], rel=1e-6)
    assert 0 < noisy["orbit"] < noisy["own"]
    # The square of the mean difference over that of its error.
    assert 0.3 < noisy["difference"] < 3


def test_a_network_without_a_group_has_no_orbit():
    for name in ("plain", "canonical"):
        with pytest.raises(UserError, match="need a group"):
            untrained(name, orbit_targets=True, observation_noise=0.1)
    assert untrained("plain-augmented", orbit_targets=True, observation_noise=0.1)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--seeds", "0"], "seeds and steps must be at least 1, and batches at least 2"),
        (["--task", "PikCube-v1"], "did you mean 'PickCube-v1'"),
        (["--policies", "ed"], "did you mean 'edp'"),
    ],
)
def test_mistakes_in_measuring_the_variance(arguments, words, capsys):
    assert gradient_variance.main([*arguments, "--demonstrations", "1"]) == 2
    assert words in capsys.readouterr().err
