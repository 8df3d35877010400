"""Symmetries of parameters keep the function; alignment finds them; known heights of barriers."""

from __future__ import annotations

import json

import pytest
import torch

from symsteer.errors import UserError
from symsteer.leaderboard.text import MINUS, SPACE
from symsteer.policies import POLICIES
from tests.policies.conftest import ACT, OBS, noises, observations
from tools.minima import barriers, symmetries, transfer
from tools.pages import minima as page

POLICY = {"channels": 12, "width": 16, "depth": 2}
LIFTED = [
    ("edp", {"group": "C8"}),
    ("edp", {"group": "D4"}),
    ("plain", {"group": "C2"}),
    ("plain-augmented", {"group": "C2"}),
]


def untrained(name="edp", seed=0, **options):
    """A policy all of whose parameters are random, biases and norms included; float64."""
    kind = POLICIES.get(name)
    torch.manual_seed(seed)
    policy = kind(kind.Options(**{**POLICY, **options}), OBS, ACT).double()
    for parameter in policy.denoiser.parameters():
        parameter.data += 0.2 * torch.randn_like(parameter)
    return policy.freeze()


@pytest.mark.parametrize(("name", "options"), LIFTED)
def test_symmetries_keep_the_function(name, options):
    policy = untrained(name, **options)
    geometry = symmetries.Geometry.of(policy)
    parts = symmetries.parts_of(policy, geometry)
    obs, noise = observations(9).double(), noises(9).double()
    before = policy.decode(obs, noise)
    move = symmetries.random_move(parts, geometry, torch.Generator().manual_seed(3))
    for other in (
        symmetries.moved(parts, move, geometry),
        symmetries.balanced(parts, geometry),
    ):
        symmetries.put(policy, other, geometry)
        torch.testing.assert_close(policy.decode(obs, noise), before, atol=1e-10, rtol=0)
        # Parameters have moved, and not by a little.
        assert sum(float((parts[key] - other[key]).square().sum()) for key in parts) > 10


@pytest.mark.parametrize("name", barriers.NAMES)
def test_all_policies_take_as_many_steps(name):
    kind = POLICIES.get(name)
    assert kind(barriers._options(kind, 12), OBS, ACT).options.steps == 12


@pytest.mark.parametrize(("name", "options"), LIFTED)
def test_alignment_finds_a_move(name, options):
    policy = untrained(name, **options)
    geometry = symmetries.Geometry.of(policy)
    parts = symmetries.parts_of(policy, geometry)
    move = symmetries.random_move(parts, geometry, torch.Generator().manual_seed(4))
    other = symmetries.moved(parts, move, geometry)
    back = symmetries.moved(other, symmetries.align(parts, other, geometry), geometry)
    for key in parts:
        torch.testing.assert_close(back[key], parts[key], msg=key)


def test_alignment_brings_other_networks_nearer():
    first, second = untrained(seed=0), untrained(seed=1)
    geometry = symmetries.Geometry.of(first)
    fixed, other = (symmetries.parts_of(policy, geometry) for policy in (first, second))
    near = symmetries.moved(other, symmetries.align(fixed, other, geometry), geometry)
    assert symmetries.product(fixed, near) > symmetries.product(fixed, other) + 1
    assert symmetries.product(near, near) == pytest.approx(symmetries.product(other, other))


@pytest.mark.parametrize("options", [{"name": "so2"}, {"network": "unet"}])
def test_other_networks_are_refused(options):
    with pytest.raises(UserError, match="use edp, plain or plain-augmented with network=mlp"):
        symmetries.Geometry.of(untrained(**options))


def test_a_barrier_is_the_height_above_the_line_between_the_ends():
    assert barriers.barrier([1.0, 2.0, 3.0]) == 0
    assert barriers.barrier([1.0, 0.5, 3.0]) == 0
    assert barriers.barrier([1.0, 5.0, 4.0, 4.0]) == pytest.approx(3.0)


class Turned:
    """A policy whose noise is multiplied by a matrix first."""

    def __init__(self, policy, matrix):
        self.policy, self.matrix = policy, matrix

    def __getattr__(self, name):
        return getattr(self.policy, name)

    def decode(self, obs, noise):
        return self.policy.decode(obs, (noise.flatten(1) @ self.matrix.mT).view_as(noise))


def test_noise_is_aligned_with_a_policy_that_sees_it_turned():
    policy, size = untrained(group="C4"), 8 * ACT.dim
    policy.float()
    generator = torch.Generator().manual_seed(0)
    skew = 0.1 * torch.randn(size, size, generator=generator)
    matrix = torch.linalg.matrix_exp(skew - skew.mT)
    other, obs = Turned(policy, matrix), observations(256)
    found = transfer.align_noise(policy, other, obs)

    def change(noise):
        return (noise.flatten(1) @ found.mT).view_as(noise)

    before = transfer.agreement(policy, other, obs, lambda noise: noise)
    after = transfer.agreement(policy, other, obs, change)
    assert before < 0.8 < 0.95 < after


def test_a_folder_without_runs(tmp_path, capsys):
    assert transfer.main([str(tmp_path)]) == 2
    assert "has no runs" in capsys.readouterr().err


def test_tables():
    rows = [
        {
            "policy": "edp",
            "apart": "start",
            "losses": {way: [1.0, high, 3.0] for way in page.WAYS.values()},
            "distance": {},
            "success": {},
        }
        for high in (2.0, 4.0)
    ]
    # Nothing above the line, and 2 of a mean loss of 2.
    assert page.barriers(rows).splitlines()[-1].count("0.50 [0.00, 1.00]") == 4
    rows = [
        {"agent": "standard", "moved": moved, "alone": 0.5, "own_actor": 0.8, "aligned": moved}
        for moved in (0.5, 0.7, 0.6, 0.6, 0.9, 0.9)
    ]
    (row,) = page.gains(rows).splitlines()[2:]
    # Pairs gain .1, .1 and .4; t with two degrees of freedom is 4.303.
    assert row.split(" | ")[1].replace(SPACE, " ") == f"+0.20 [{MINUS}0.23, +0.63]"


@pytest.mark.long
def test_the_whole_measurement(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(barriers, "EPISODES", 2)
    words = ["--policies", "edp", "--count", "2", "--demonstrations", "2", "--steps", "2"]
    assert barriers.main([str(tmp_path), *words]) == 0
    first = capsys.readouterr().out
    rows = json.loads(first)["rows"]
    assert [row["apart"] for row in rows] == [*barriers.APART] * 2
    for row in rows:
        ends = {(round(line[0], 5), round(line[-1], 5)) for line in row["losses"].values()}
        assert len(ends) == 1
        assert len(row["losses"]["aligned"]) == barriers.POINTS
        assert row["distance"]["aligned"] <= row["distance"]["trained"]
    # What is trained stays.
    monkeypatch.setattr(barriers, "train", None)
    assert barriers.main([str(tmp_path), *words]) == 0
    assert capsys.readouterr().out == first
    # With one more of them all have other normalisers, and must be trained again.
    with pytest.raises(TypeError):
        barriers.main([str(tmp_path), *words, "--count", "3"])
