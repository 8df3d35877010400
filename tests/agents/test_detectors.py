"""Detectors on a world that is symmetric but for one place."""

import math

import pytest
import torch
from scipy.stats import mannwhitneyu
from scipy.stats import t as student_t

from symsteer.agents.detectors import DETECTORS
from symsteer.agents.detectors.evidential import REGULARIZER, nig_loss
from symsteer.agents.replay import Batch
from symsteer.errors import UserError
from symsteer.policies.geometry import Field, Group, Layout
from tests.agents.conftest import EXECUTE, Problem
from tests.marks import long_except

C4 = Group.parse("C4")
WORLD = Problem(
    Layout([Field("tcp_xy", 1), Field("tcp_z", 0)]), Layout([Field("xy", 1), Field("z", 0)])
)
LEAST = {
    "neighbours": {"neighbours": 0.7},
    "gate": {"gate": 0.7, "disagreement": 0.6},
    "ensemble": {"orbit": 0.8},
    "evidential": {"evidential": 0.9},
    "atlas": {"atlas": 0.6},
}
"""Area under the ROC curve that every score must reach."""


def decisions(count, seed, broken=True):
    """Points in a disc that move as they are told, but for those behind a wall."""
    generator = torch.Generator().manual_seed(seed)
    angle = 2 * math.pi * torch.rand(count, generator=generator)
    radius = torch.rand(count, generator=generator).sqrt()
    place = radius[:, None] * torch.stack([angle.cos(), angle.sin()], 1)
    obs = torch.cat([place, torch.rand(count, 1, generator=generator)], 1)
    actions = torch.rand(count, EXECUTE, 3, generator=generator) * 2 - 1
    blocked = (place[:, 0] > 0.3) & (place[:, 1].abs() < 0.4)
    moved = 0.3 * actions.mean(1)
    if broken:
        moved = moved * torch.where(blocked, 0.0, 1.0)[:, None]
    batch = Batch(
        obs=obs, actions=actions, next_obs=obs + moved, reward=-torch.ones(count), blocked=blocked
    )
    return batch


def fitted(name, broken=True, seed=0):
    detector = DETECTORS.get(name)(WORLD.context(seed=seed), C4)
    detector.fit(decisions(4000, seed, broken))
    return detector


def auroc(score, label):
    wins = mannwhitneyu(score[label].numpy(), score[~label].numpy()).statistic
    return wins / (label.sum() * (~label).sum()).item()


@pytest.fixture(autouse=True)
def fewer_steps(monkeypatch):
    for module in ("detector", "gate"):
        monkeypatch.setattr(f"symsteer.agents.detectors.{module}.STEPS", 600)


@pytest.mark.parametrize("name", long_except(list(DETECTORS), "ensemble", "evidential"))
def test_they_find_the_place_where_the_symmetry_is_broken(name):
    test = decisions(1000, seed=7)
    found = fitted(name).scores(test.obs, test.actions)
    for score, least in LEAST[name].items():
        assert auroc(found[score], test.blocked) > least, score


@pytest.mark.long
@pytest.mark.parametrize("name", list(DETECTORS))
def test_they_do_not_find_it_where_there_is_none(name):
    test = decisions(1000, seed=7)
    found = fitted(name, broken=False).scores(test.obs, test.actions)
    for score in LEAST[name]:
        assert abs(auroc(found[score], test.blocked) - 0.5) < 0.2, score


def test_departures_are_from_the_majority_of_the_orbit():
    detector = DETECTORS.get("neighbours")(WORLD.context(), C4)
    orbit = torch.zeros(4, 2, detector.outcomes.dim)
    orbit[0, 0, 0] = 2.0  # the first decision differs from its copies
    orbit[2, 1, 0] = 2.0  # a copy of the second one does
    # One of three blocks, mean over its two numbers.
    torch.testing.assert_close(detector.departure(orbit), torch.tensor([2.0 / 3, 0.0]))


def test_the_orbit_of_an_equivariant_prediction_is_one_point():
    detector = DETECTORS.get("neighbours")(WORLD.context(), C4)
    inputs = torch.randn(5, detector.inputs.dim, generator=torch.Generator().manual_seed(0))

    def predict(x):
        return torch.cat([x[:, :2].flip(1) * torch.tensor([-1.0, 1.0]), x[:, 2:4] * 0], 1)

    orbit = detector.orbit(inputs, predict)
    torch.testing.assert_close(orbit, orbit[:1].expand_as(orbit))


def test_the_evidence_is_a_student_t_density():
    """Equation 6 of the paper: 2 alpha degrees of freedom, scale^2 = beta (1 + nu) / (nu alpha)."""
    error, nu, alpha, beta = (torch.tensor(x).double() for x in (0.7, 0.3, 2.5, 1.2))
    scale = (beta * (1 + nu) / (nu * alpha)).sqrt()
    expected = -student_t.logpdf(error, df=2 * alpha, scale=scale)
    regularizer = REGULARIZER * error * (2 * nu + alpha)
    assert nig_loss(error, nu, alpha, beta) - regularizer == pytest.approx(expected)


def test_too_few_decisions_are_refused():
    with pytest.raises(UserError, match="at least 200 decisions, not 50"):
        DETECTORS.get("neighbours")(WORLD.context(), C4).fit(decisions(50, 0))
