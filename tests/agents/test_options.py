"""Options of the learners, and the presets."""

import dataclasses
import json
import pickle
import tomllib
from pathlib import Path

import pytest
import torch

from symsteer.agents import AGENTS, presets
from symsteer.agents.options import SacOptions
from symsteer.agents.presets import preset_options
from symsteer.agents.sac import SacAgent
from symsteer.agents.standard import StandardAgent
from symsteer.errors import UserError

ROOT = Path(__file__).parents[2]
PRESETS = sorted(path.stem for path in presets.FOLDER.glob("*.toml"))
PAGE = (ROOT / "docs" / "agents.md").read_text()
RESULTS = ROOT / "leaderboard" / "results"
TRAINED = [name for name in AGENTS.builtin if issubclass(AGENTS.get(name), SacAgent)]


REFUSED = {
    **{
        (name, preset): "its critic_kind is sampler"
        for name in ("residual", "best-of-n")
        for preset in ("dsrl", "dsrl-na", "first")
    },
    **{("displaced", preset): "no entropy bonus" for preset in ("dsrl", "dsrl-na")},
    **{("partial", preset): "aliased or sampler" for preset in ("dsrl", "first")},
    ("partial", "dsrl-na"): "noise_bank of at least 1",
}
"""What a preset sets contradicts what the agent is."""


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", AGENTS.builtin)
def test_presets_load_for_every_agent(problem, name, preset):
    kind = AGENTS.get(name)
    wanted = preset_options(preset, name, kind.Options)
    if words := REFUSED.get((name, preset)):
        with pytest.raises(UserError, match=words):
            kind.Options(**wanted)
        return
    options = kind.Options(**wanted)
    if name in TRAINED:
        assert wanted == {key: getattr(options, key) for key in wanted}
        small = {"width": 16, "batch_size": 8, "warmup": 0, "utd": 1.0}
        agent = problem.agent(name, **{**vars(options), **small})
        agent.observe(problem.transition(8, rows=agent.rows))
        for batch in agent.batches():
            scalars = agent.update(batch)
        assert agent.updates == 8
        assert all(torch.isfinite(value) for value in scalars.values())


DSRL = {  # ajwagen/dsrl, both variants
    "gamma": 0.99,
    "lr": 3e-4,
    "alpha_lr": 3e-4,
    "batch_size": 256,
    "tau": 0.005,
    "critics": 2,
    "reduce": "min",
    "activation": "tanh",
    "layer_norm": True,
    "depth": 3,
    "soft_backup": True,
    "timeouts_terminal": True,
    "target_entropy": 0.0,
    "initial_alpha": 1.0,
    "reward_scale": 1.0,
    "utd": 20 / 4,  # 20 updates after each step of four environments
}
CALLS = 20  # updates of action critic and actor in one call; then 10 of the noise critic
EXECUTED = 4


@pytest.mark.parametrize(
    ("preset", "own"),
    [
        (
            "dsrl",  # Transport
            {
                "critic_kind": "noise",
                "width": 128,
                "noise_bound": 1.0,
                "warmup": 640_000 // EXECUTED,
            },
        ),
        (
            "dsrl-na",  # Can
            {
                "critic_kind": "aliased",
                "width": 2048,
                "noise_bound": 1.5,
                "warmup": 24_000 // EXECUTED,
                "distill": "gaussian",
                "distill_steps": 10 / CALLS,
                "noise_bank": 0,
            },
        ),
    ],
)
def test_presets_are_the_published_settings(preset, own):
    options = StandardAgent.Options(**preset_options(preset, "standard", StandardAgent.Options))
    found = {key: getattr(options, key) for key in DSRL | own}
    assert found == DSRL | own


class Quick(StandardAgent):
    name = "quick"
    Options = SacOptions


def test_a_preset_can_be_the_defaults(tmp_path, monkeypatch):
    monkeypatch.setattr(presets, "FOLDER", tmp_path)
    (tmp_path / "found.toml").write_text("[quick]\nlr = 0.125\ncritics = 3\n")
    own = type("Quick", (Quick,), {"__module__": __name__, "__qualname__": "Quick"})
    kind = presets.defaults_of("found")(own)
    options = kind.Options()
    assert isinstance(options, SacOptions)
    assert vars(options) == {**vars(SacOptions()), "lr": 0.125, "critics": 3}
    assert kind.Options(lr=0.5).lr == 0.5
    assert Quick.Options().lr == SacOptions().lr
    with pytest.raises(UserError, match="lr must be positive"):
        kind.Options(lr=0)
    (tmp_path / "found.toml").write_text("[quick]\nlearning_rate = 0.125\n")
    with pytest.raises(UserError, match="no option of quick 'learning_rate'"):
        presets.defaults_of("found")(Quick)


SEARCHED = ("standard", "standard-matched", "augmented", "equivariant", "wrong-group")
SEARCHED += ("residual-pathway", "slow", "free-bias")


@pytest.mark.parametrize("name", AGENTS.builtin)
def test_agents_have_what_was_chosen_for_them_and_travel_to_other_processes(name):
    options = AGENTS.get(name).Options()
    chosen = preset_options("minimax" if name in SEARCHED else "tuned", name, type(options))
    assert {key: getattr(options, key) for key in chosen} == chosen
    assert pickle.loads(pickle.dumps(options)) == options
    own = name in tomllib.loads((presets.FOLDER / "tuned.toml").read_text())
    owner = AGENTS.get("equivariant" if name == "wrong-group" else name)
    assert not own or type(options).__qualname__ == f"{owner.__qualname__}.Options"


def test_what_tuning_chose_is_the_committed_choice():
    """Of all agents that a plan tuned, and to the digits that the preset has."""
    trials = json.loads((RESULTS / "tuning" / "core.json").read_text())
    for choice in trials["chosen"]:
        chosen = preset_options("tuned", choice["agent"], AGENTS.get(choice["agent"]).Options)
        assert chosen.keys() == choice["options"].keys()
        for name, value in choice["options"].items():
            wanted = pytest.approx(value, rel=1e-3) if isinstance(value, float) else value
            assert chosen[name] == wanted, name
    assert len(trials["chosen"]) == 5


def test_the_control_has_the_settings_of_the_agent_that_it_controls():
    wrong, right = (AGENTS.get(name).Options() for name in ("wrong-group", "equivariant"))
    assert vars(wrong) == vars(right)
    wrong, right = (
        preset_options("tuned", name, type(wrong)) for name in ("wrong-group", "equivariant")
    )
    assert wrong == right


def test_the_page_names_every_agent_option_and_preset():
    kinds = [AGENTS.get(name).Options for name in AGENTS.builtin]
    options = [field.name for kind in kinds for field in dataclasses.fields(kind)]
    for name in {*AGENTS.builtin, *PRESETS, *options}:
        assert f"`{name}`" in PAGE, name


BAD = [
    ("standard", {"gamma": 1.0}, r"gamma must lie in \[0, 1\), not 1.0"),
    ("standard", {"tau": 0.0}, r"tau must lie in \(0, 1\]"),
    ("standard", {"lr": -1.0}, "lr must be positive"),
    ("standard", {"width": 0}, "width must be positive"),
    ("standard", {"noise_bound": 0.0}, "noise_bound must be positive"),
    ("standard", {"warmup": -1}, "warmup must not be negative"),
    ("standard", {"reduce": "median"}, "no reduce 'median'"),
    ("equivariant", {"group": "X8"}, "X8"),
    ("equivariant", {"group": "SO2"}, "SO2 is not finite"),
    ("relaxed", {"filters": 0}, "filters must be at least 1"),
    ("projected", {"penalty": -1.0}, "penalty must not be negative"),
    ("constrained", {"dual_lr": -1.0}, "dual_lr must not be negative"),
    *(
        ("ensemble", {name: -1.0}, f"{name} must not be negative")
        for name in ("actor_regularizer", "critic_regularizer")
    ),
    ("displaced", {"displacement": 0.0}, "displacement must be positive"),
    ("displaced", {"soft_backup": True}, "the displaced agent has no entropy bonus"),
    ("displaced", {"layers": "convolutional"}, "no layers 'convolutional'"),
    ("residual", {"critic_kind": "noise"}, "the residual agent .* its critic_kind is sampler"),
    ("residual", {"residual_bound": 0.0}, "residual_bound must lie"),
    ("residual", {"residual_bound": 3.0}, "residual_bound must lie"),
    ("residual", {"ramp": -1}, "ramp must not be negative"),
    ("best-of-n", {"critic_kind": "aliased"}, "best-of-n .* its critic_kind is sampler"),
    ("best-of-n", {"noise_bank": 0}, "best-of-n needs a noise_bank of at least 1, not 0"),
    ("best-of-n", {"soft_backup": True}, "best-of-n has no entropy bonus"),
    ("partial", {"critic_kind": "noise"}, "its critic_kind is aliased or sampler"),
    ("partial", {"gate": "open"}, "no gate 'open'"),
    ("partial", {"fence": -1.0}, "fence must not be negative"),
    ("partial", {"noise_bank": 0}, "noise_bank of at least 1"),
    ("golden-ticket", {"candidates": 1}, "candidates must be at least 2, not 1"),
]


@pytest.mark.parametrize(("name", "options", "words"), BAD, ids=str)
def test_bad_options_are_refused(name, options, words):
    with pytest.raises(UserError, match=words):
        AGENTS.get(name).Options(**options)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("all = 1", "all: Input should be a valid dictionary"),
        (
            "[all]\n[[base]]\nx = 1",
            "base: Input should be a valid dictionary",
        ),
        (f"[all.{'x.' * 5000}x]", "nested more than 32 levels deep"),
        (f"all = {'[' * 5000}", "recursion"),
    ],
)
def test_a_preset_that_is_not_made_of_tables_is_refused(tmp_path, text, words):
    path = tmp_path / "mine.toml"
    path.write_text(text)
    with pytest.raises(UserError, match=rf"the preset {path}.*{words}.*; correct it"):
        preset_options(str(path), "standard", AGENTS.get("standard").Options)
