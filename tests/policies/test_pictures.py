"""Pictures from above: turned with the layout, encoded exactly for quarter turns, learned from."""

from __future__ import annotations

import math
import sys

import pytest
import torch

from symsteer.agents.agent import AgentContext
from symsteer.errors import UserError
from symsteer.policies.files import load_policy, save_policy
from symsteer.policies.geometry import Field, Group, Layout
from symsteer.policies.networks.denoiser import parameter_count
from symsteer.policies.networks.pictures import PictureEncoder
from symsteer.policies.picture import PIXEL
from symsteer.policies.symmetry.joint import merged_layout
from tests.marks import policy_class
from tests.policies.conftest import ACT, SMALL, as_type, assert_exact, noises
from tests.policies.test_in_hand import SEEN as IN_HAND

SIDE = 32
HALF = SIDE * PIXEL / 2
SEEN = Layout(
    [
        Field("tcp", 1),
        Field("picture_height", 0, SIDE**2),
        Field("picture_red", 0, SIDE**2),
        Field("goal", 1),
    ]
)


def observe(count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Observations of a bar about a random place ``[count, 2]``, and that place, metres."""
    generator = torch.Generator().manual_seed(seed)
    place = (2 * torch.rand(count, 2, generator=generator) - 1) * HALF / 2
    line = (torch.arange(SIDE) + 0.5) * PIXEL - HALF
    x, y = line - place[:, :1, None], -line[:, None] - place[:, 1:, None]
    heights = 0.05 * (-(x**2) / 0.03**2 - y**2 / 0.015**2).exp()
    red = 0.5 * heights.roll((1, 2), (1, 2))
    told = 2 * torch.rand(count, 4, generator=generator) - 1
    return torch.cat([told[:, :2], heights.flatten(1), red.flatten(1), told[:, 2:]], dim=1), place


def episodes(count: int, lifted: float = 1.0) -> list[tuple[torch.Tensor, torch.Tensor]]:
    """The tool moves to where the bar is; the first episode's is ``lifted`` times as high."""
    obs, place = observe(9 * count)
    heights = SEEN.slice("picture_height")
    obs[:9, heights] *= lifted
    actions = torch.zeros(9 * count, ACT.dim)
    actions[:, ACT.slice("xy")] = place / HALF
    rows = zip(obs.split(9), actions.split(9), strict=True)
    return [(seen, action[:-1]) for seen, action in rows]


def fit(name: str, steps: int = 2, count: int = 2, lifted: float = 1.0, **options):
    policy = policy_class(name)
    options = {**SMALL, "steps": steps, "horizon": 2, "execute": 1, **options}
    return policy.fit(policy.Options(**options), episodes(count, lifted), SEEN, ACT)


def encoder_of(group: str) -> PictureEncoder:
    torch.manual_seed(0)
    encoder = PictureEncoder(SEEN.picture, Group.parse(group)).double()
    encoder.scale.copy_(torch.tensor([0.05, 0.025]))
    return encoder


def test_a_layout_knows_its_picture() -> None:
    picture, (obs, place) = SEEN.picture, observe(5)
    assert picture is not None
    assert (picture.channels, picture.side) == (("height", "red"), SIDE)
    assert picture.rest == Layout([Field("tcp", 1), Field("goal", 1)])
    seen = picture.of(obs)
    pixel = seen[:, 0].flatten(1).argmax(1)
    row, column = pixel // SIDE, pixel % SIDE
    top = torch.stack([column + 0.5, SIDE - 0.5 - row], 1) * PIXEL - HALF
    torch.testing.assert_close(top, place, atol=PIXEL, rtol=0)
    assert torch.equal(picture.changed(obs, obs[:, picture.rest_columns], seen), obs)
    assert ACT.picture is None


@pytest.mark.parametrize(
    "fields",
    [
        [Field("tcp", 1), Field("picture_height", 0, 15)],
        [Field("tcp", 1), Field("picture_height", 0, 16), Field("picture_red", 0, 9)],
        [Field("tcp", 1), Field("picture_height", 1, 16)],
        [Field("picture_height", 0, 16)],
    ],
)
def test_a_picture_is_a_square_of_scalars_beside_something_else(fields) -> None:
    with pytest.raises(UserError, match="one scalar for each pixel of the same square"):
        _ = Layout(fields).picture


def test_a_picture_turns_with_the_rest_of_the_observation() -> None:
    obs, place = observe(4)
    obs = obs.double()
    there, back = SEEN.transform(obs, math.pi / 2), SEEN.transform(obs, -math.pi / 2)
    assert torch.equal(SEEN.transform(there, math.pi), back)
    assert not torch.equal(there, back)
    quarter = torch.full((4,), math.pi / 2)
    torch.testing.assert_close(SEEN.rotate(obs, quarter), there)
    several = torch.stack([obs, back], dim=1)
    turned = SEEN.rotate(several, quarter.index_fill(0, torch.tensor([1]), 0.3))
    torch.testing.assert_close(turned[[0, 2, 3]], torch.stack([there, obs], 1)[[0, 2, 3]])
    torch.testing.assert_close(turned[1], SEEN.transform(several[1], 0.3))
    # What is turned lies where its place is turned to, between pixels, too.
    for angle, reflect in ((0.3, False), (2.5, False), (0.8, True)):
        seen = SEEN.picture.of(SEEN.transform(obs, angle, reflect))[:, 0]
        line = (torch.arange(SIDE, dtype=seen.dtype) + 0.5) * PIXEL - HALF
        middle = torch.stack([(seen.sum(1) * line).sum(1), -(seen.sum(2) * line).sum(1)], 1)
        middle /= seen.sum((1, 2))[:, None]
        wanted = Layout([Field("xy", 1)]).transform(place.double(), angle, reflect)
        torch.testing.assert_close(middle, wanted, atol=0.002, rtol=0)
        told = SEEN.transform(obs, angle, reflect)[:, SEEN.slice("goal")]
        goal = Layout([Field("goal", 1)]).transform(obs[:, SEEN.slice("goal")], angle, reflect)
        torch.testing.assert_close(told, goal)


@pytest.mark.parametrize("group", ["C2", "C4", "C8"])
def test_the_encoder_commutes_with_quarter_turns(group) -> None:
    obs = observe(3)[0].double()
    encoder = encoder_of(group)
    for network in (encoder, encoder.expanded()):
        told = network(obs)
        assert told.shape == (3, network.layout.dim)
        for angle, _ in network.group.elements:
            turned = network(SEEN.transform(obs, angle))
            error = (turned - network.layout.transform(told, angle)).abs().max()
            quarter = (2 * angle / math.pi) % 1 == 0
            assert error < 1e-12 if quarter else 1e-12 < error < 0.01
            assert angle == 0 or (turned - told).abs().max() > 1e-4


@pytest.mark.parametrize("group", ["C1", "C8"])
@pytest.mark.parametrize("scale", [1.0, 0.1])
def test_a_keypoint_lies_on_what_is_shown_before_anything_is_learned(group, scale) -> None:
    obs, place = observe(16)
    encoder = encoder_of(group)
    obs[:, SEEN.picture.columns] *= scale
    told, layout = encoder(obs.double()), encoder.layout
    for k in range(encoder.keypoints):
        found = told[:, layout.slice(f"keypoint{k}_place")]
        assert (found - place).norm(dim=1).max() < 2 * PIXEL
        height = told[:, layout.slice(f"keypoint{k}_height")]
        assert height.min() > 0.01 * scale


def test_a_pixel_is_found_whatever_its_sign_and_channels_have_like_mass() -> None:
    encoder = encoder_of("C4")
    with torch.no_grad():
        encoder.weigh.weight.zero_()
    pixels = torch.zeros(2, 2, SIDE, SIDE, dtype=torch.float64)
    pixels[:, 0, 3, 30] = -0.05
    pixels[1, 1, 5, 2] = 0.025
    told = encoder.encode(torch.nn.functional.pad(pixels.flatten(1), (2, 2)))
    first = torch.tensor([30.5, SIDE - 3.5]).double() * PIXEL - HALF
    second = torch.tensor([2.5, SIDE - 5.5]).double() * PIXEL - HALF
    wanted = torch.stack([first, (first + second) / 2])
    found = told[:, encoder.told.slice("keypoint0_place")]
    torch.testing.assert_close(found, wanted, atol=0.01 * PIXEL, rtol=0)
    height = told[:, encoder.told.slice("keypoint0_height")].flatten()
    torch.testing.assert_close(height, height.new_tensor([-0.05, -0.025]), atol=1e-4, rtol=0)


def test_of_an_empty_picture_the_centre_is_told() -> None:
    obs = observe(3)[0].double()
    obs[:, SEEN.picture.columns] = 0.0
    encoder = encoder_of("C4")
    assert torch.equal(encoder.encode(obs), torch.zeros(3, encoder.told.dim).double())


def test_one_changed_weight_of_a_filter_is_noticed() -> None:
    fast, obs = encoder_of("C4").expanded(), observe(3)[0].double()
    fast.layers[1].weight[0, 0, 0, 0] += 0.1
    turned = fast(SEEN.transform(obs, math.pi / 2))
    assert (turned - fast.layout.transform(fast(obs), math.pi / 2)).abs().max() > 1e-6


def test_the_plain_encoder_has_as_many_parameters_and_tells_as_much() -> None:
    picture = Layout([Field("tcp", 1), Field("picture_height", 0, SIDE**2)]).picture
    equivariant, plain = (PictureEncoder(picture, Group.parse(g)) for g in ("C8", "C1"))
    assert parameter_count(plain) == pytest.approx(parameter_count(equivariant), rel=0.1)
    assert plain.told.dim == pytest.approx(equivariant.told.dim, rel=0.1)


def test_quarter_turns_need_a_side_that_they_keep() -> None:
    picture = Layout([Field("tcp", 1), Field("picture_height", 0, 30**2)]).picture
    with pytest.raises(UserError, match="a picture of 30 x 30 pixels has no quarter turns"):
        PictureEncoder(picture, Group.parse("C4"))
    with pytest.raises(UserError, match="its symmetry must be C_n"):
        fit("edp", group="D4")


@pytest.mark.parametrize("seen", [SEEN, IN_HAND], ids=["above", "hand"])
def test_without_escnn_nothing_is_begun_and_no_good_file_is_called_damaged(
    seen, tmp_path, monkeypatch
) -> None:
    policy = policy_class("edp")
    options = policy.Options(**SMALL)
    state = torch.random.get_rng_state()
    policy.check(options, seen)
    assert torch.equal(torch.random.get_rng_state(), state)
    path = save_policy(policy(options, seen, ACT), tmp_path)
    monkeypatch.setitem(sys.modules, "escnn", None)
    for call in (lambda: policy.check(options, seen), lambda: load_policy(path)):
        with pytest.raises(UserError, match=r"install it with: pip install --no-deps") as error:
            call()
        assert "damaged" not in str(error.value)


def test_decoding_is_strict_in_what_the_encoder_tells() -> None:
    policy = fit("edp", group="C8")
    obs, _ = observe(4, seed=1)
    seen = policy.see(obs)
    assert policy.task_layout == SEEN
    assert policy.obs_layout.fields[0].name == "tcp"
    assert policy.obs_layout.fields[-1].name == "goal"
    assert_exact(policy, obs=seen)
    with as_type(torch.float64, policy):
        noise, obs = noises(4)[:, :2].double(), obs.double()
        chunk = policy.decode(policy.see(obs), noise)
        quarter = math.pi / 2
        turned = policy.decode(
            policy.see(SEEN.transform(obs, quarter)), ACT.transform(noise, quarter)
        )
        torch.testing.assert_close(turned, ACT.transform(chunk, quarter), atol=1e-10, rtol=0)


def test_what_a_picture_tells_has_unit_size() -> None:
    policy = fit("edp", count=4)
    obs, _ = observe(36)
    known = policy.normalized_observation(policy.see(obs))
    assert known.abs().max() <= 1.0 + 1e-6
    torch.testing.assert_close(policy.eyes.scale, torch.tensor([0.05, 0.025]), atol=0.002, rtol=0)


def test_agents_see_what_is_told_at_the_size_that_it_has_after_training() -> None:
    policy = fit("edp", count=4)
    seen, layout = policy.see(observe(36)[0]), policy.obs_layout
    known = policy.normalized_observation(seen)
    agents = AgentContext.of(policy).normalize_obs
    # With random weights some heights, which have no frequency, are constant.
    fields = [layout.slice(field.name) for field in policy.eyes.told.fields if field.frequency]
    before, after = ([x[:, own].abs().max() for own in fields] for x in (known, agents(seen)))
    assert min(before) < 0.2
    assert min(after) > 0.7
    turned = agents(layout.transform(seen, math.pi / 4))
    wanted = layout.transform(agents(seen), math.pi / 4)
    torch.testing.assert_close(turned, wanted, atol=1e-5, rtol=0)


@pytest.mark.long
@pytest.mark.parametrize("lifted", [1, 6])
def test_the_place_is_learned(lifted) -> None:
    policy = fit("edp", steps=150, count=60, lifted=lifted, batch_size=64, group="C4")
    obs, place = observe(64, seed=2)
    chunk = policy.decode(policy.see(obs), torch.zeros(64, 2, ACT.dim))
    moved = chunk[:, 0, ACT.slice("xy")] * HALF
    assert (moved - place).norm(dim=1).mean() < 0.15 * place.norm(dim=1).mean()


@pytest.mark.parametrize("name", ["edp", "plain", "plain-augmented", "escnn"])
def test_policies_of_pictures_can_be_saved(name, tmp_path) -> None:
    policy = fit(name)
    obs, noise = observe(3)[0], noises(3)[:, :2]
    loaded = load_policy(save_policy(policy, tmp_path), SEEN, ACT)
    assert loaded.task_layout == SEEN
    assert torch.equal(loaded.decode(loaded.see(obs), noise), policy.decode(policy.see(obs), noise))


def test_augmentation_turns_the_picture_too() -> None:
    policy = fit("plain-augmented", augmentation="D4")
    obs, chunks = observe(16)[0], torch.zeros(16, 2, ACT.dim)
    turned, _ = policy.augment(obs, chunks, torch.Generator().manual_seed(0))
    elements = [SEEN.transform(obs, *element) for element in Group.parse("D4").elements]
    same = torch.stack([(copy == turned).all(1) for copy in elements])
    assert (same.sum(0) == 1).all()
    assert same.any(1).sum() > 3


@pytest.mark.parametrize("name", ["canonical", "frame-averaged", "so2"])
def test_policies_without_an_encoder_say_which_have_one(name) -> None:
    with pytest.raises(
        UserError, match=f"{name} has no encoder of what these cameras see; .*edp, escnn"
    ):
        fit(name)


def test_pictures_have_no_place_among_several_tasks() -> None:
    with pytest.raises(UserError, match="Seen shows a picture"):
        merged_layout({"Seen": SEEN})


@pytest.mark.parametrize("name", ["edp-joint", "plain-joint", "edp-told"])
@pytest.mark.parametrize("seen", [SEEN, IN_HAND], ids=["above", "hand"])
def test_a_policy_for_several_tasks_refuses_pictures_before_the_work(name, seen) -> None:
    policy = policy_class(name)
    with pytest.raises(UserError, match=r"the task shows a picture, .* such as edp, for each task"):
        policy.check(policy.Options(), seen)
