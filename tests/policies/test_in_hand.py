"""Pictures from the hand: signals on a sphere, turned into the world's axes exactly."""

from __future__ import annotations

import math

import pytest
import torch

from symsteer.errors import UserError
from symsteer.policies.files import load_policy, save_policy
from symsteer.policies.geometry import Field, Group, Layout
from symsteer.policies.networks.denoiser import parameter_count
from symsteer.policies.networks.in_hand import AXES, AveragedHandEncoder, HandEncoder, _frequency_4
from symsteer.policies.networks.irreps import SpatialIrreps
from symsteer.policies.picture import hand_rays, turn_pictures
from tests.marks import policy_class
from tests.policies.conftest import ACT, SMALL, as_type, assert_exact, noises

SIDE = 32
SEEN = Layout(
    [
        Field("tcp", 1),
        *(Field(name, 1) for name in AXES),
        Field("hand_distance", 0, SIDE**2),
        Field("goal", 1),
    ]
)
POLICIES = ["edp", "escnn", "so2", "spherical", "frame-averaged", "canonical", "plain"]
ANGLES = [0.3, math.pi / 4, 2.0]


def rotations(count: int, seed: int = 0) -> torch.Tensor:
    """Of space, ``[count, 3, 3]`` float64."""
    generator = torch.Generator().manual_seed(seed)
    q, _ = torch.linalg.qr(torch.randn(count, 3, 3, generator=generator, dtype=torch.float64))
    return q * torch.linalg.det(q)[:, None, None]


def yaw(angle: float) -> torch.Tensor:
    return Layout([Field("v_xy", 1), Field("v_z", 0)]).matrix(angle)


def observe(count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Observations of a ball near the camera's axis, and its place from the camera, metres."""
    generator = torch.Generator().manual_seed(seed)
    drawn = 2 * torch.rand(count, 9, generator=generator, dtype=torch.float64) - 1
    # The hand looks down, up to half a radian.
    turn = torch.matrix_exp(torch.linalg.cross(torch.eye(3).double()[None], drawn[:, None, :3] / 2))
    heading = torch.stack([yaw(3 * float(angle)) for angle in drawn[:, 3]])
    turn = turn @ heading @ torch.diag(torch.tensor([1.0, -1.0, -1.0], dtype=torch.float64))
    ball = torch.stack([0.1 * drawn[:, 4], 0.1 * drawn[:, 5], 0.2 + 0.05 * drawn[:, 6]], 1)
    rays = hand_rays(SIDE)
    along = ball @ rays.T
    gap = 0.04**2 - (ball.square().sum(1)[:, None] - along**2)
    distance = torch.where(gap > 0, along - gap.clamp_min(0).sqrt(), 0.0)
    told = [drawn[:, :2], *turn[:, :2].unbind(2), distance, drawn[:, 7:]]
    return torch.cat(told, dim=1), (turn @ ball[:, :, None])[:, :, 0]


def episodes(count: int) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """The tool moves to where the ball is."""
    obs, place = observe(9 * count)
    actions = torch.zeros(9 * count, ACT.dim)
    actions[:, ACT.slice("xy")] = 5 * place[:, :2].float()
    rows = zip(obs.float().split(9), actions.split(9), strict=True)
    return [(seen, action[:-1]) for seen, action in rows]


def fit(name: str, steps: int = 2, count: int = 2, **options):
    policy = policy_class(name)
    known = {key: value for key, value in SMALL.items() if hasattr(policy.Options, key)}
    options = {**known, "steps": steps, "horizon": 2, "execute": 1, **options}
    return policy.fit(policy.Options(**options), episodes(count), SEEN, ACT)


def encoder_of(group: str, kind=HandEncoder):
    torch.manual_seed(0)
    encoder = kind(SEEN.picture, Group.parse(group)).double()
    encoder.scale.fill_(0.3)
    return encoder


def parts_of(encoder, told: torch.Tensor, name: str) -> torch.Tensor:
    """One of what a picture tells, of all keypoints, ``[B, keypoints, numbers]``."""
    layout = encoder.told
    return torch.stack([told[:, layout.slice(name.format(k))] for k in range(encoder.keypoints)], 1)


def test_a_turned_scene_has_the_same_picture_and_a_mirrored_one_is_flipped() -> None:
    picture, (obs, _) = SEEN.picture, observe(3)
    assert picture is not None
    assert (picture.channels, picture.side, picture.in_hand) == (("distance",), SIDE, True)
    for angle, reflect in ((0.7, False), (math.pi / 2, True)):
        turned = SEEN.transform(obs, angle, reflect)
        wanted = picture.of(obs).flip(-1) if reflect else picture.of(obs)
        assert torch.equal(picture.of(turned), wanted)
        rest = picture.rest.transform(obs[:, picture.rest_columns], angle, reflect)
        assert torch.equal(turned[:, picture.rest_columns], rest)
    turned = SEEN.rotate(obs, torch.full((3,), 0.7))
    torch.testing.assert_close(turned, SEEN.transform(obs, 0.7))


def test_harmonics_turn_by_wigners_matrices() -> None:
    irreps, turn, other = SpatialIrreps(), rotations(5), rotations(5, seed=1)
    n = rotations(5, seed=2)[:, 0]
    there = irreps.harmonics((turn @ n[:, :, None])[:, :, 0])
    matrix = irreps.rotation(turn)
    torch.testing.assert_close(there, (matrix @ irreps.harmonics(n)[:, :, None])[:, :, 0])
    torch.testing.assert_close(matrix @ irreps.rotation(other), irreps.rotation(turn @ other))
    # Orthogonal functions: over all pixels of the six pictures around the camera.
    rays = torch.randn(200_000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    values = irreps.harmonics(torch.nn.functional.normalize(rays, dim=1))
    gram = values.T @ values / len(values)
    torch.testing.assert_close(gram, torch.diag(gram.diag()), atol=0.01, rtol=0)


@pytest.mark.parametrize(
    ("group", "kind"), [("C8", HandEncoder), ("C1", HandEncoder), ("C4", AveragedHandEncoder)]
)
def test_what_is_told_turns_with_scene_and_hand_by_any_angle(group, kind) -> None:
    encoder, (obs, _) = encoder_of(group, kind), observe(4)
    for network in (encoder, encoder.expanded()):
        told = network(obs)
        assert told.shape == (4, network.layout.dim)
        for angle in ANGLES:
            turned = network(SEEN.transform(obs, angle))
            assert (turned - network.layout.transform(told, angle)).abs().max() < 1e-12
            assert (turned - told).abs().max() > 1e-2


def test_the_parts_of_degree_0_and_1_turn_with_every_rotation_of_space() -> None:
    encoder, (obs, _) = encoder_of("C4"), observe(4)
    picture, turn, space = encoder.picture.of(obs), encoder.orientation(obs), rotations(4)
    told, turned = encoder.in_world(picture, turn), encoder.in_world(picture, space @ turn)
    wanted = encoder.told.turn(told, space)
    for name in (
        "keypoint{}_axis_xy",
        "keypoint{}_axis_z",
        "keypoint{}_distance",
        "camera_to_keypoint{}_xy",
        "camera_to_keypoint{}_z",
    ):
        torch.testing.assert_close(*(parts_of(encoder, t, name) for t in (turned, wanted)))
    # So does the size of degree 2, where frequencies mix.
    shapes = [
        torch.cat([t[:, encoder.told.slice(f"shape{j}")] for j in range(3)], 1)
        for t in (told, turned)
    ]
    torch.testing.assert_close(*(s.norm(dim=1) for s in shapes))
    assert (shapes[0] - shapes[1]).abs().max() > 1e-2


def test_frequency_4_tells_how_a_square_is_turned() -> None:
    line = torch.linspace(-0.02, 0.02, 21, dtype=torch.float64)
    square = torch.cartesian_prod(line, line)[None, None] + 0.1
    weights = torch.ones(1, 2, 1, square.shape[2], dtype=torch.float64)
    told = _frequency_4(weights, square)
    # The mean of z^4 over that of |z|^4 is -3/7 in a square whose sides are along the axes.
    assert told == pytest.approx(torch.tensor([[[-3 / 7, 0.0]] * 2]), abs=0.02)
    layout = Layout([Field("shape4", 4)])
    for angle in (0.3, math.pi / 4):
        turned = _frequency_4(weights, Layout([Field("v", 1)]).transform(square, angle))
        torch.testing.assert_close(turned, layout.transform(told, angle), atol=1e-4, rtol=0)


def rolled(encoder, obs: torch.Tensor, angle: float) -> torch.Tensor:
    """The largest change of what is told if the hand turns about the camera's axis, not the scene.

    The picture turns. Of all, and of all but frequency 4, ``[2]``.
    """
    picture, turn = encoder.picture.of(obs), encoder.orientation(obs)
    turned = turn_pictures(picture, picture.new_full((len(obs),), angle))
    told = encoder.in_world(turned, turn @ yaw(angle)) - encoder.in_world(picture, turn)
    return torch.stack(
        [told.abs().max(), told[:, : encoder.told.slice("shape4").start].abs().max()]
    )


@pytest.mark.parametrize(
    ("group", "kind"), [("C4", HandEncoder), ("C8", HandEncoder), ("C8", AveragedHandEncoder)]
)
def test_a_quarter_turn_of_the_hand_alone_changes_nothing(group, kind) -> None:
    encoder, (obs, _) = encoder_of(group, kind), observe(4)
    assert (rolled(encoder, obs, math.pi / 2) < 1e-12).all()
    # Distances that are interpolated at an edge lie far off, which a fourth power tells.
    assert 1e-12 < rolled(encoder, obs, math.pi / 4)[1] < 0.1
    if kind is HandEncoder:
        fast = encoder.expanded()
        assert (rolled(fast, obs, math.pi / 2) < 1e-12).all()
        fast.layers[1].weight[0, :, 1, 2] += 0.1
        assert (rolled(fast, obs, math.pi / 2) > 1e-6).all()
    assert (rolled(encoder_of("C1"), obs, math.pi / 2) > 1e-4).all()


def test_a_keypoint_is_the_mean_of_seen_points() -> None:
    encoder, (obs, place) = encoder_of("C4"), observe(6)
    told = encoder.encode(obs)
    surface = parts_of(encoder, told, "camera_to_keypoint{}_xy").mean(1)
    # The near side of a ball of 4 cm.
    torch.testing.assert_close(surface, place[:, :2], atol=0.04, rtol=0)
    far = parts_of(encoder, told, "keypoint{}_distance")[:, :, 0]
    assert ((far > place.norm(dim=1)[:, None] - 0.041) & (far < place.norm(dim=1)[:, None])).all()
    nothing = SEEN.picture.changed(obs, obs[:, SEEN.picture.rest_columns], 0 * SEEN.picture.of(obs))
    assert not encoder.encode(nothing).any()


def test_the_plain_encoder_has_as_many_parameters_and_tells_as_much() -> None:
    equivariant, plain = encoder_of("C8"), encoder_of("C1")
    assert parameter_count(plain) == pytest.approx(parameter_count(equivariant), rel=0.1)
    assert plain.told == equivariant.told


@pytest.mark.parametrize("name", ["edp", "so2", "spherical", "frame-averaged", "canonical"])
def test_decoding_is_strict_in_the_task_observation(name) -> None:
    """Other than with a picture from above, also where quarter turns do not suffice."""
    policy = fit(name)
    (obs, _), noise = observe(4, seed=1), noises(4)[:, :2].double()
    assert_exact(policy, obs=policy.see(obs.float()))
    angles = ANGLES if name in ("so2", "spherical", "canonical") else [math.pi / 4, math.pi / 2]
    with as_type(torch.float64, policy):
        chunk = policy.decode(policy.see(obs), noise)
        for angle in angles:
            turned = policy.see(SEEN.transform(obs, angle)), ACT.transform(noise, angle)
            wanted = ACT.transform(chunk, angle)
            torch.testing.assert_close(policy.decode(*turned), wanted, atol=1e-10, rtol=0)


def test_relative_actions_of_a_plain_network_know_no_direction() -> None:
    """The guide's recipe: all that the network sees and does is in the hand's axes."""
    policy = fit("canonical", anchor="tcp_x_axis", symmetry="C4")
    assert isinstance(policy.eyes, AveragedHandEncoder)
    (obs, _), noise = observe(4, seed=1), noises(4)[:, :2]
    seen = []
    policy._inference()[0].register_forward_hook(lambda _, inputs, __: seen.append(inputs))
    for angle in (0.0, 1.0):
        turned = SEEN.transform(obs.float(), angle)
        policy.decode(policy.see(turned), ACT.transform(noise, angle))
    first, last = seen[0], seen[len(seen) // 2]
    for one, other in zip(first, last, strict=True):
        torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-5)


def test_what_a_picture_tells_has_unit_size() -> None:
    policy = fit("edp", count=4)
    obs = observe(36)[0].float()
    assert float(policy.eyes.scale) == pytest.approx(SEEN.picture.of(obs).max())
    known = policy.normalized_observation(policy.see(obs))
    told = known[:, policy.eyes.start : policy.eyes.start + policy.eyes.told.dim]
    assert 0.5 < told.abs().max() <= 2.5


@pytest.mark.long
def test_the_place_is_learned() -> None:
    policy = fit("edp", steps=150, count=60, batch_size=64, group="C4")
    obs, place = observe(64, seed=2)
    chunk = policy.decode(policy.see(obs.float()), torch.zeros(64, 2, ACT.dim))
    moved, wanted = chunk[:, 0, ACT.slice("xy")], (5 * place[:, :2]).float()
    assert (moved - wanted).norm(dim=1).mean() < 0.3 * wanted.norm(dim=1).mean()


@pytest.mark.parametrize("name", POLICIES)
def test_policies_that_see_from_the_hand_can_be_saved(name, tmp_path) -> None:
    policy = fit(name)
    obs, noise = observe(3)[0].float(), noises(3)[:, :2]
    loaded = load_policy(save_policy(policy, tmp_path), SEEN, ACT)
    assert torch.equal(loaded.decode(loaded.see(obs), noise), policy.decode(policy.see(obs), noise))


def test_augmentation_flips_the_pictures_of_mirrored_scenes() -> None:
    policy = fit("plain-augmented", augmentation="D4")
    obs, chunks = observe(16)[0].float(), torch.zeros(16, 2, ACT.dim)
    turned, _ = policy.augment(obs, chunks, torch.Generator().manual_seed(0))
    flipped = (SEEN.picture.of(turned) == SEEN.picture.of(obs).flip(-1)).flatten(1).all(1)
    same = (SEEN.picture.of(turned) == SEEN.picture.of(obs)).flatten(1).all(1)
    assert (flipped != same).all()
    assert 3 < flipped.sum() < 13


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ([Field("tcp", 1), Field("hand_distance", 0, 64)], "tcp_x_axis, tcp_y_axis, tcp_z_axis"),
        ([*SEEN.fields[:4], Field("hand_red", 0, 64)], "is one field hand_distance"),
        ([*SEEN.fields[:4], Field("hand_distance", 0, 36)], "6 x 6 pixels has no quarter turns"),
        ([*SEEN.fields, Field("picture_height", 0, SIDE**2)], "and no other picture"),
        ([*SEEN.fields[:4], Field("hand_distance", 0, 65)], "one scalar for each pixel"),
    ],
)
def test_an_encoder_says_what_it_needs(fields, message) -> None:
    policy = policy_class("edp")
    with pytest.raises(UserError, match=message):
        policy.check(policy.Options(), Layout(fields))


def test_a_group_with_reflections_is_refused() -> None:
    for name in ("edp", "frame-averaged"):
        with pytest.raises(UserError, match="its symmetry must be C_n"):
            fit(name, group="D4")
