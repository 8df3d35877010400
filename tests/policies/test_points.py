"""Clouds of points: exact under the group, indifferent to the order of the points, learned."""

from __future__ import annotations

import pytest
import torch

from symsteer.errors import UserError
from symsteer.policies.files import load_policy, save_policy
from symsteer.policies.geometry import Field, Group, Layout
from symsteer.policies.networks.points import PointEncoder
from symsteer.policies.normalizer import Normalizer
from symsteer.policies.symmetry.joint import merged_layout
from tests.marks import policy_class
from tests.policies.conftest import ACT, SMALL, assert_exact, noises

POINTS = 12
SEEN = Layout(
    [Field("tcp", 1), Field("width", 0), Field("cloud_xy", 1, POINTS), Field("cloud_z", 0, POINTS)]
)


def observe(count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Observations of a flat square about a random place ``[count, 2]``, and that place."""
    generator = torch.Generator().manual_seed(seed)
    place = 2 * torch.rand(count, 2, generator=generator) - 1
    spread = 0.2 * torch.rand(count, POINTS, 3, generator=generator) - 0.1
    points = spread + torch.nn.functional.pad(place, (0, 1))[:, None]
    told = 2 * torch.rand(count, 3, generator=generator) - 1
    return torch.cat([told, points[:, :, :2].flatten(1), points[:, :, 2]], dim=1), place


def episodes(count: int) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """The tool moves to the points' middle."""
    obs, place = observe(9 * count)
    actions = torch.zeros(9 * count, ACT.dim)
    reach = place - obs[:, :2]
    actions[:, ACT.slice("xy")] = reach / reach.norm(dim=1, keepdim=True).clamp_min(0.25)
    rows = zip(obs.split(9), actions.split(9), strict=True)
    return [(seen, action[:-1]) for seen, action in rows]


def fit(name: str, steps: int = 2, count: int = 2, **options):
    policy = policy_class(name)
    options = {**SMALL, "steps": steps, "horizon": 2, "execute": 1, **options}
    return policy.fit(policy.Options(**options), episodes(count), SEEN, ACT)


def test_a_layout_knows_its_points() -> None:
    cloud = SEEN.cloud
    assert cloud is not None
    assert cloud.point == Layout([Field("xy", 1), Field("z", 0)])
    assert cloud.rest == Layout([Field("tcp", 1), Field("width", 0)])
    obs, place = observe(5)
    points = obs[:, cloud.columns]
    assert points.shape == (5, POINTS, 3)
    torch.testing.assert_close(points[:, :, :2].mean(1), place, atol=0.1, rtol=0)
    assert torch.equal(obs[:, cloud.rest_columns], obs[:, :3])
    assert ACT.cloud is None


@pytest.mark.parametrize(
    "fields",
    [
        [Field("tcp", 1), Field("cloud_xy", 1, 3), Field("cloud_z", 0, 4)],
        [Field("cloud_xy", 1, 3), Field("cloud_z", 0, 3)],
    ],
)
def test_a_cloud_needs_as_many_heights_as_places_and_something_beside_it(fields) -> None:
    with pytest.raises(UserError, match=r"the same number of points, and other fields"):
        _ = Layout(fields).cloud


def test_points_share_their_scale() -> None:
    obs, _ = observe(50)
    fitted, places = Normalizer.fit(SEEN, obs), SEEN.slice("cloud_xy")
    assert (fitted.scale[places] == fitted.scale[places][0]).all()
    assert fitted.scale[SEEN.slice("cloud_z")].unique().numel() == 1
    farthest = obs[:, places].reshape(-1, 2).norm(dim=1).max().item()
    assert fitted.scale[places][0] == pytest.approx(farthest)
    alone = Normalizer.fit(SEEN.cloud.rest, obs[:, :3])
    assert torch.equal(fitted.scale[:3], alone.scale)
    assert torch.equal(fitted.offset[:3], alone.offset)


@pytest.mark.parametrize("group", ["C4", "C8", "D4"])
def test_decoding_commutes_with_the_group_and_with_every_order(group) -> None:
    policy = fit("edp", group=group)
    obs, _ = observe(4, seed=1)
    assert_exact(policy, obs=obs)
    noise = noises(4)[:, :2]
    chunk = policy.decode(obs, noise)
    mixed, columns = obs.clone(), SEEN.cloud.columns
    mixed[:, columns] = obs[:, columns.flip(0)]
    assert (policy.decode(mixed, noise) - chunk).abs().max() < 1e-5
    mixed[:, columns] = obs[:, columns].flip(0)
    assert (policy.decode(mixed, noise) - chunk).abs().max() > 1e-4


def test_a_point_that_occurs_twice_counts_once_and_is_met_with_the_rest() -> None:
    """Where few points are visible, some are repeated."""
    encoder = PointEncoder(SEEN.cloud.point, Group.parse("C4"), 8)
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(3, 5, 3, generator=generator)
    known = torch.randn(3, 4, 8, generator=generator)
    seen = encoder(points, known)
    torch.testing.assert_close(encoder(points[:, [0, 1, 2, 3, 4, 4, 4]], known), seen)
    assert not torch.allclose(encoder(points, 2 * known), seen)
    fast = encoder.expanded()
    torch.testing.assert_close(fast(points, known), seen)
    assert not list(fast.parameters())


def test_the_place_of_the_points_is_learned() -> None:
    policy = fit("edp", steps=120, count=60, batch_size=64)
    obs, place = observe(64, seed=2)
    chunk = policy.decode(obs, torch.zeros(64, 2, ACT.dim))
    moved = chunk[:, 0, ACT.slice("xy")]
    reach = place - obs[:, :2]
    wanted = reach / reach.norm(dim=1, keepdim=True).clamp_min(0.25)
    assert (moved - wanted).norm(dim=1).mean() < 0.35 * wanted.norm(dim=1).mean()


@pytest.mark.parametrize("name", ["plain", "escnn", "frame-averaged"])
def test_other_policies_take_clouds_and_can_be_saved(name, tmp_path) -> None:
    policy = fit(name)
    obs, _ = observe(3)
    noise = noises(3)[:, :2]
    loaded = load_policy(save_policy(policy, tmp_path))
    assert torch.equal(loaded.decode(obs, noise), policy.decode(obs, noise))


def test_clouds_have_no_place_among_several_tasks() -> None:
    with pytest.raises(UserError, match="Seen shows a cloud of points"):
        merged_layout({"Seen": SEEN})
