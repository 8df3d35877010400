"""The pictures of turned copies: a star in the unbroken world, and what each break does to it."""

import numpy as np
import pytest

from symsteer.policies.geometry import Group
from tools.pictures.orbits import Orbit, draw, orbit


@pytest.fixture(scope="module")
def unbroken() -> Orbit:
    return orbit("none")


def spread(paths: np.ndarray) -> float:
    """Largest distance in mm between paths ``[T, 8, 2]`` that are turned back."""
    angles = [angle for angle, _ in Group.parse("C8").elements]
    back = np.array([[[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]] for a in angles])
    turned = np.einsum("tgi,gij->tgj", paths, back)
    return float(np.linalg.norm(turned - turned[:, :1], axis=-1).max())


def test_unbroken_copies_are_a_star(unbroken: Orbit) -> None:
    assert spread(unbroken.object) < 8 < 50 < np.ptp(unbroken.object[:, 0], axis=0).max()
    assert spread(unbroken.tool) < 8
    np.testing.assert_allclose(unbroken.seen, unbroken.object[0], atol=1e-3)
    assert (unbroken.cost == 1).all()
    assert (unbroken.origin == 0).all()


def test_broken_dynamics_bend_it(unbroken: Orbit) -> None:
    broken = orbit("action_gain:1")
    np.testing.assert_allclose(broken.object[0], unbroken.object[0], atol=0.1)
    assert spread(broken.object) > 20


def test_other_breaks_leave_the_paths(unbroken: Orbit) -> None:
    biased, paid = orbit("perception_bias:1"), orbit("directional_reward:1")
    np.testing.assert_allclose(biased.object, unbroken.object, atol=1e-3)
    np.testing.assert_allclose(biased.seen - biased.object[0], [[20, 0]] * 8, atol=0.1)
    assert 1.2 < paid.cost.max() <= 2
    np.testing.assert_allclose(paid.object, unbroken.object, atol=1e-3)


def test_resets_and_the_centre(unbroken: Orbit) -> None:
    sector, offset = orbit("spawn_sector:1"), orbit("frame_offset:1")
    bearing = np.degrees(np.arctan2(*sector.starts.T[::-1]))
    assert np.abs(bearing).max() < 23
    assert np.abs(np.degrees(np.arctan2(*unbroken.starts.T[::-1]))).max() > 150
    np.testing.assert_allclose(offset.origin, [50, 0], atol=1e-3)
    assert draw("spawn_sector", unbroken, sector).startswith(b"\x89PNG")
