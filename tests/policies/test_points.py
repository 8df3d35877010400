"""Clouds of points: exact under the group, indifferent to the order of the points, learned."""

from __future__ import annotations

import pytest
import torch

from symsteer.errors import UserError
from symsteer.policies.files import load_policy, save_policy
from symsteer.policies.geometry import Field, Group, Layout
from symsteer.policies.networks.denoiser import parameter_count
from symsteer.policies.networks.points import CloudEncoder
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


def encoder_of(group: str) -> CloudEncoder:
    torch.manual_seed(0)
    encoder = CloudEncoder(SEEN.cloud, Group.parse(group)).double()
    encoder.scale.fill_(0.1)
    return encoder


@pytest.mark.parametrize("group", ["C4", "C8"])
def test_the_encoder_commutes_with_the_group_and_with_every_order(group) -> None:
    encoder, obs = encoder_of(group), observe(3)[0].double()
    told = encoder(obs)
    assert told.shape == (3, encoder.layout.dim)
    for network in (encoder, encoder.expanded()):
        for angle, _ in network.group.elements:
            turned = network(SEEN.transform(obs, angle))
            error = (turned - network.layout.transform(told, angle)).abs().max()
            assert error < 1e-12
            assert angle == 0 or (turned - told).abs().max() > 1e-4
    mixed, columns = obs.clone(), SEEN.cloud.columns
    mixed[:, columns] = obs[:, columns.flip(0)]
    torch.testing.assert_close(encoder(mixed), told)
    mixed[:, columns] = obs[:, columns].flip(0)
    assert (encoder(mixed) - told).abs().max() > 1e-4


def test_a_point_that_occurs_several_times_counts_once() -> None:
    """Where few points are visible, some are repeated."""
    encoder, obs = encoder_of("C4"), observe(3)[0].double()
    columns = SEEN.cloud.columns
    once, twice = obs.clone(), obs.clone()
    # The last two points are copies of one, or of two others.
    once[:, columns[-2:]] = obs[:, columns[[0, 0]]]
    twice[:, columns[-2:]] = obs[:, columns[[1, 2]]]
    torch.testing.assert_close(encoder(twice), encoder(once), atol=1e-12, rtol=0)


def test_what_the_keypoints_tell_is_about_the_points() -> None:
    """Their mean is among the points; heights have a scale of their own."""
    encoder, (obs, place) = encoder_of("C8"), observe(5)
    told, layout = encoder(obs.double()), encoder.layout
    assert (told[:, layout.slice("keypoint0_place")] - place).norm(dim=1).max() < 0.15
    assert told[:, layout.slice("keypoint0_z")].abs().max() < 0.1
    fitted = encoder.statistics(obs.double(), Normalizer.fit(SEEN.cloud.rest, obs[:, :3]))
    assert encoder.scale.item() == pytest.approx(obs[:, SEEN.cloud.columns][..., 2].abs().max())
    assert torch.equal(fitted.scale[:3], Normalizer.fit(SEEN.cloud.rest, obs[:, :3]).scale)


def test_the_plain_encoder_has_as_many_parameters_and_tells_as_much() -> None:
    equivariant, plain = (CloudEncoder(SEEN.cloud, Group.parse(group)) for group in ("C8", "C1"))
    assert parameter_count(plain) == pytest.approx(parameter_count(equivariant), rel=0.1)
    assert plain.told.dim == pytest.approx(equivariant.told.dim, rel=0.1)


def test_a_point_has_a_place_and_a_height() -> None:
    cloud = Layout([Field("tcp", 1), Field("cloud_xy", 1, 3), Field("cloud_red", 0, 3)]).cloud
    with pytest.raises(UserError, match=r"needs the fields cloud_xy .* and cloud_z"):
        CloudEncoder(cloud, Group.parse("C4"))


@pytest.mark.parametrize("group", ["C4", "C8"])
def test_decoding_commutes_with_the_group_in_what_the_task_shows(group) -> None:
    policy = fit("edp", group=group)
    obs, noise = observe(4, seed=1)[0], noises(4)[:, :2]
    seen = policy.see(obs)
    assert_exact(policy, obs=seen)
    for angle, _ in policy.group.elements:
        turned = policy.see(SEEN.transform(obs, angle))
        torch.testing.assert_close(turned, policy.obs_layout.transform(seen, angle))
    assert policy.obs_layout.cloud is None
    assert policy.task_layout == SEEN
    assert policy.decode(seen, noise).shape == noise.shape


def test_the_place_of_the_points_is_learned() -> None:
    policy = fit("edp", steps=120, count=60, batch_size=64)
    obs, place = observe(64, seed=2)
    chunk = policy.decode(policy.see(obs), torch.zeros(64, 2, ACT.dim))
    moved = chunk[:, 0, ACT.slice("xy")]
    reach = place - obs[:, :2]
    wanted = reach / reach.norm(dim=1, keepdim=True).clamp_min(0.25)
    assert (moved - wanted).norm(dim=1).mean() < 0.35 * wanted.norm(dim=1).mean()


@pytest.mark.parametrize("name", ["plain", "plain-augmented", "escnn"])
def test_other_policies_take_clouds_and_can_be_saved(name, tmp_path) -> None:
    policy = fit(name)
    seen, noise = policy.see(observe(3)[0]), noises(3)[:, :2]
    loaded = load_policy(save_policy(policy, tmp_path))
    assert torch.equal(loaded.see(observe(3)[0]), seen)
    assert torch.equal(loaded.decode(seen, noise), policy.decode(seen, noise))


def test_a_policy_of_clouds_without_an_encoder_is_of_another_time(tmp_path, monkeypatch) -> None:
    policy = fit("edp")
    tensors = {k: v for k, v in policy.state_dict().items() if not k.startswith("eyes.")}
    monkeypatch.setattr(policy, "state_dict", lambda: tensors)
    with pytest.raises(UserError, match="of a time when clouds had no encoder; train it again"):
        load_policy(save_policy(policy, tmp_path))


@pytest.mark.parametrize(
    ("name", "options", "problem"),
    [
        ("frame-averaged", {}, "has no encoder of what these cameras see"),
        ("edp", {"group": "D4"}, "commutes with rotations alone"),
    ],
)
def test_policies_without_an_encoder_refuse_clouds(name, options, problem) -> None:
    with pytest.raises(UserError, match=problem):
        fit(name, **options)


def test_clouds_have_no_place_among_several_tasks() -> None:
    with pytest.raises(UserError, match="Seen shows a cloud of points"):
        merged_layout({"Seen": SEEN})
