"""Variants: names and strengths, what strength 0 means, and that every one works everywhere."""

import functools

import pytest
import torch

from symsteer.bench.sim.environment import check_cuda
from symsteer.bench.tasks import EMBODIMENTS, make
from symsteer.bench.tasks.experts import Expert
from symsteer.bench.variants import VARIANTS, build, evaluation_variants, highest_cost, parse, read
from symsteer.errors import UserError
from symsteer.variant import VariantSpec, specs_at, variant_text
from tests.bench.shared import STATE_TASKS
from tests.bench.variants.scenes import act, scene
from tests.marks import slow_except

NAMES = sorted(VARIANTS)


@pytest.mark.parametrize(
    ("text", "part"),
    [
        ("action_gian:0.5", "did you mean 'action_gain'"),
        ("", "valid: none, gravity_tilt"),
        ("earthquake:0.5", "valid: none, gravity_tilt, .*, spawn_sector"),
        ("action_gain", "needs a strength"),
        ("action_gain:", "no strength can be read"),
        ("action_gain:nan", "no strength can be read"),
        ("action_gain:1.5", r"\[0, 1\]"),
        ("wind:0.1+gravity_tilt:-7", r"'gravity_tilt' must lie in \[0, 1\]"),
        ("action_gain:0.1+action_gain:0.2", "named twice"),
        ("action_gain:0.1+", "there is no variant ''"),
        ("none+wind:0.1", r"none .* must stand alone.* leave it out of 'none\+wind:0"),
        ("none:hard", "must stand alone"),
        ("wind:0.5..0.2", r"must be a range such as 0.2..0.8 within \[0, 1\]; they are 0.5..0.2"),
        ("wind:0.5..", "no strength can be read"),
        ("wind:0..1.5", r"must lie in \[0, 1\]"),
        ("wind:1@", "no strength can be read"),
        ("wind:1@0", "must begin within the budget"),
        ("wind:1@0.8..0.2", "must begin within the budget"),
        ("wind:1@2", "must begin within the budget"),
    ],
)
def test_bad_text_is_explained(text, part):
    for place in (None, ("PickCube-v1", "floating")):
        with pytest.raises(UserError, match=part) as error:
            read(text, place=place)
        assert "\n" not in str(error.value)


def test_text_becomes_data_and_objects():
    assert read("none") == parse("none") == ()
    assert read("action_gain:0") == (VariantSpec("action_gain", 0.0),)
    assert parse("action_gain:0") == ()
    (variant,) = parse("action_gain:0.5")
    assert (variant.name, variant.strength) == ("action_gain", 0.5)
    assert read("action_gain", 0.25) == (VariantSpec("action_gain", 0.25),)
    specs = read("gravity_tilt:0.30+action_gain:0.5")
    assert variant_text(specs) == "gravity_tilt:0.3+action_gain:0.5"
    assert read(specs) == specs
    assert [v.name for v in build(specs)] == ["gravity_tilt", "action_gain"]
    (each,) = read("wind", torch.tensor([0.0, 0.5]))
    assert each == VariantSpec("wind", (0.0, 0.5))
    with pytest.raises(UserError, match="single variant"):
        read([each, *specs])
    with pytest.raises(UserError, match="valid: none, gravity_tilt"):
        read([VariantSpec("winde", 0.5)])
    VARIANTS.get("wind")  # what is imported needs no consent
    (own,) = parse("symsteer.bench.variants.wind:Wind:0.5")
    assert type(own) is VARIANTS.get("wind")
    assert own.name == "symsteer.bench.variants.wind:Wind"
    with pytest.raises(UserError, match="must be a class that inherits from"):
        parse("symsteer.bench.variants.base:overriding:0.5")
    assert parse("none", 0.0) == ()
    for text, strength, part in (
        ("none", 0.5, "without a variant"),
        ("action_gain:0.5", 0.5, "given twice"),
        ("action_gain", torch.tensor([0.5, 1.2]), r"\[0, 1\]"),
        ("action_gain", "a lot", r"\[0, 1\]"),
    ):
        with pytest.raises(UserError, match=part):
            parse(text, strength)


def test_the_strength_may_grow_during_a_run_or_be_drawn_for_each_episode():
    text = "wind:0.1..0.5+obstacle:1@0.5+action_gain:0.8@0.25..0.75+frame_offset:0..1@1"
    specs = read(text)
    assert variant_text(specs) == text
    assert specs[0] == VariantSpec("wind", 0.5, low=0.1)
    assert specs[1] == VariantSpec("obstacle", 1.0, rise=(0.5, 0.5))
    expected = {
        0: "wind:0.1..0.5",
        0.25: "wind:0.1..0.5",
        0.375: "wind:0.1..0.5+action_gain:0.2",
        0.5: "wind:0.1..0.5+obstacle:1+action_gain:0.4",
        0.75: "wind:0.1..0.5+obstacle:1+action_gain:0.8",
        1: "wind:0.1..0.5+obstacle:1+action_gain:0.8+frame_offset:0..1",
    }
    for share, present in expected.items():
        assert variant_text(specs_at(specs, share)) == present
    assert variant_text(specs_at(read("wind:0.5..1@0.25..0.75"), 0.5)) == "wind:0.25..0.5"
    assert [spec.is_constant for spec in (*specs, *read("wind:1"))] == [False] * 4 + [True]
    with pytest.raises(UserError, match=r"in the course of a run.*give obstacle:1, or use it with"):
        build(specs)
    with pytest.raises(UserError, match=r"built with the scene.*one number, e.g. obstacle:0.5"):
        parse("obstacle:0..1")


def test_evaluation_leaves_out_what_is_for_training_alone():
    for text, kept in (
        ("spawn_sector:1", "none"),
        ("wind:0.5+spawn_sector:1+action_gain:0.5", "wind:0.5+action_gain:0.5"),
    ):
        assert variant_text(evaluation_variants(read(text))) == kept


def test_highest_cost():
    assert highest_cost(parse("directional_reward:0.5+wind:1")) == 1.5
    assert highest_cost(parse("directional_reward", torch.tensor([0.2, 0.75]))) == 1.75


@pytest.mark.parametrize("name", NAMES)
def test_every_variant_says_what_its_strength_means(name):
    assert "strength" in VARIANTS.get(name).__doc__
    assert VARIANTS.summary(name)


# ------------------------------------------------------------------- strength 0


@functools.cache
def script(embodiment):
    """Actions of the expert with some noise: the cube is touched and pushed."""
    env = make("PushCube-v1", num_envs=3, embodiment=embodiment)
    env.reset(seed=[1, 2, 3])
    expert, generator = Expert(env), torch.Generator().manual_seed(0)
    actions = []
    for _ in range(14):
        actions.append(expert.act() + 0.3 * torch.randn(3, 7, generator=generator))
        env.step(actions[-1])
    moved = (env.manipulated.linear_velocity.norm(dim=1) > 0.05).any()
    env.close()
    assert moved, "the script is meant to have contacts in it"
    return actions


@functools.cache
def play(embodiment, task="PushCube-v1", **kwargs):
    """All that an episode, a partial reset and some more steps show: ``[N, ...]`` tensors."""
    env = make(task, num_envs=3, embodiment=embodiment, reward_mode="normalized_dense", **kwargs)
    shown = [env.reset(seed=[1, 2, 3])[0].clone()]

    def step(action):
        obs, reward, terminated, truncated, info = env.step(action)
        shown.extend([obs.clone(), reward.clone(), terminated.clone(), truncated.clone()])
        shown.append(info["success"].clone())

    for action in script(embodiment):
        step(action)
    shown.append(env.reset(options={"env_idx": torch.tensor([0, 1])})[0].clone())
    step(script(embodiment)[0])
    shown.append(env.get_state().clone())
    env.close()
    return shown


@pytest.mark.parametrize("embodiment", ["floating", pytest.param("panda", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", NAMES)
def test_strength_zero_is_the_unbroken_task_to_the_bit(name, embodiment):
    """Also beside an environment in which the variant acts, as it shows there."""
    unbroken, mixed = play(embodiment), play(embodiment, variant=name, strength=(0.0, 1.0, 0.0))
    for plain, broken in zip(unbroken, mixed, strict=True):
        assert torch.equal(plain[[0, 2]], broken[[0, 2]])
    if name not in ("obstacle", "friction_patch"):  # which have tests of their own where they act
        pairs = zip(unbroken, mixed, strict=True)
        assert not all(torch.equal(plain[1], broken[1]) for plain, broken in pairs)


SHOWN = ["camera_rotation", "frame_rotation", "observation_noise", "obstacle", "perception_bias"]


@pytest.mark.parametrize("task", ["HeightPushCube-v1", "HandPushCube-v1"])
@pytest.mark.parametrize("name", slow_except(SHOWN, "frame_rotation", "observation_noise"))
def test_strength_zero_leaves_pictures_as_they_are_to_the_bit(name, task):
    plain = play("floating", task)
    mixed = play("floating", task, variant=name, strength=(0.0, 1.0, 0.0))
    for one, other in zip(plain, mixed, strict=True):
        assert torch.equal(one[[0, 2]], other[[0, 2]])
    assert not torch.equal(plain[0][1], mixed[0][1])


def test_strength_zero_of_all_is_the_unbroken_task_to_the_bit():
    everything = play("floating", variant="+".join(f"{name}:0" for name in NAMES))
    for plain, zero in zip(play("floating"), everything, strict=True):
        assert torch.equal(plain, zero)


# ---------------------------------------------------------------- drawn strengths


@pytest.mark.parametrize("embodiment", ["floating", pytest.param("panda", marks=pytest.mark.slow)])
@pytest.mark.parametrize("name", [name for name in NAMES if name != "obstacle"])
def test_an_episode_that_draws_a_strength_is_one_of_that_strength(name, embodiment):
    def episodes(variant, strength=None):
        """Two episodes of three environments; of the last one the first episode goes on."""
        env = make(
            "PushCube-v1", num_envs=3, embodiment=embodiment, variant=variant, strength=strength
        )
        shown, strengths = ([], []), []
        for episode, seeds in zip(shown, ([1, 2, 3], [4, 5]), strict=True):
            rows = torch.arange(len(seeds))
            episode.append(env.reset(seed=seeds, options={"env_idx": rows})[0].clone())
            strengths.append(env.variants[0].amount.clone())
            for action in script(embodiment)[:8]:
                obs, reward, *_ = env.step(action)
                episode.extend([obs.clone(), reward.clone()])
        env.close()
        return *shown, strengths

    *drawn, (first, second) = episodes(f"{name}:0.2..0.9")
    values = torch.cat([first, second])
    assert 0.2 < values.min() < values.max() < 0.9
    assert len(values.unique()) == 5
    assert first[2] == second[2]
    for number, rows in ((0, slice(3)), (1, slice(2))):
        constant = episodes(name, (first, second)[number])[number]
        for one, other in zip(drawn[number], constant, strict=True):
            assert torch.equal(one[rows], other[rows])


# -------------------------------------------------------------------- together


def test_they_compose():
    """Tilt and gain in one name: each does what it does alone."""
    env = scene("gravity_tilt:1+action_gain:1+perception_bias:0.5", task="PushCube-v1")
    before = env.agent.tcp_pose.p.clone()
    for _ in range(3):
        env.step(act(env, xy=(1.0, 0.0)))
    env.step(act(env))
    moved = (env.agent.tcp_pose.p - before)[:, 0]
    assert torch.allclose(moved, torch.full((2,), 0.09 * 0.4), atol=2e-3)
    assert [v.name for v in env.variants] == ["gravity_tilt", "action_gain", "perception_bias"]


def test_policy_actions_are_not_changed_in_place():
    env = scene("action_gain:1+actuator_offset:1")
    action = torch.full((2, 7), 0.5)
    env.step(action)
    assert torch.equal(action, torch.full((2, 7), 0.5))


@pytest.mark.slow
@pytest.mark.parametrize("embodiment", list(EMBODIMENTS))
@pytest.mark.parametrize("task", STATE_TASKS)
def test_every_task_takes_every_variant(task, embodiment):
    for name in NAMES:
        check_runs(make(task, num_envs=2, embodiment=embodiment, variant=name, strength=MIXED))


@pytest.mark.gpu
@pytest.mark.parametrize("name", NAMES)
def test_every_variant_runs_on_cuda(name):
    try:
        check_cuda()
    except UserError as error:
        pytest.skip(str(error))
    check_runs(make("PickCube-v1", num_envs=2, sim="cuda", variant=name, strength=MIXED))


MIXED = torch.tensor([1.0, 0.4])


def check_runs(env):
    """Two steps, a partial reset, and a state that can be set."""
    env.reset(seed=[0, 1])
    for _ in range(2):
        obs, reward, *_ = env.step(env.body.bound(torch.ones(2, 7, device=env.device)))
    env.reset(options={"env_idx": torch.tensor([1])})
    env.set_state_dict(env.get_state_dict())
    assert obs.isfinite().all()
    assert reward.isfinite().all()
    env.close()
