"""Options of the learners: when they learn, how far noise may go, and the presets."""

import dataclasses
import json
import math
import pickle
import tomllib
from pathlib import Path

import pytest
import torch

from symsteer.agents import AGENTS, presets
from symsteer.agents.agent import Budget
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


def weights(network):
    return [p.detach().clone() for p in network.parameters()]


def unchanged(network, before):
    return all(torch.equal(a, b) for a, b in zip(weights(network), before, strict=True))


# When it learns.


def test_updates_can_begin_during_the_warm_up(problem):
    agent = problem.agent("standard", warmup=64, learning_starts=16, utd=0.25)
    first, updates, random = weights(agent.actor), [], []
    for step in range(6):
        noise = agent.act(problem.batch(16).obs)
        random.append(bool(noise.abs().max() > 1.5))  # beyond the bound: N(0, I)
        agent.observe(problem.transition(16, seed=step))
        for batch in agent.batches():
            agent.update(batch)
        updates.append(agent.updates)
    assert updates == [0, 4, 8, 12, 16, 20]
    assert random == [True] * 4 + [False] * 2
    assert not unchanged(agent.actor, first)


def test_a_budget_must_outlast_warm_up_and_learning_starts():
    for late in ({"warmup": 0, "learning_starts": 40}, {"warmup": 40, "learning_starts": 0}):
        options = SacOptions(**late)
        assert options.first_update == late["learning_starts"]
        with pytest.raises(UserError, match="nothing would be learned"):
            SacAgent.check(options, Budget(160, 4, 4, 50))
        SacAgent.check(options, Budget(161, 4, 4, 50))
    assert SacOptions(warmup=7).first_update == 7


@pytest.mark.parametrize("num_envs", [1, 3, 48])
def test_updates_per_decision_do_not_depend_on_the_number_of_environments(problem, num_envs):
    agent = problem.agent("standard", warmup=48, utd=0.25)
    count = 0
    for step in range(144 // num_envs):
        agent.observe(problem.transition(num_envs, seed=step))
        count += len(list(agent.batches()))
    assert count == (144 - 48) // 4


def test_the_actor_can_start_later_than_the_critics(problem):
    agent = problem.agent("standard", actor_delay=3)
    actor, critic, alpha = weights(agent.actor), weights(agent.critic), agent.alpha
    for seed in range(3):
        scalars = agent.update(problem.batch(seed=seed))
        assert "losses/actor" not in scalars
        assert "losses/distillation" in scalars
    assert unchanged(agent.actor, actor)
    assert not unchanged(agent.critic, critic)
    assert agent.alpha == alpha
    assert "losses/actor" in agent.update(problem.batch())
    assert not unchanged(agent.actor, actor)
    assert agent.alpha != alpha


# How far noise may go.


def norms(problem, noise):
    blocks = problem.act_layout.blocks
    return torch.stack([noise[..., block].norm(dim=-1) for block in blocks], -1)


@pytest.mark.parametrize("source", ["gaussian", "squashed"])
def test_noise_of_the_warm_up_is_that_of_the_base_policy_or_within_the_bound(problem, source):
    agent = problem.agent("standard", warmup=1, warmup_noise=source, noise_bound=0.8)
    noise = agent.act(problem.batch(2000).obs)
    size = norms(problem, noise)
    assert noise.shape == (2000, problem.horizon, problem.act_layout.dim)
    assert noise.mean().abs() < 0.02
    if source == "gaussian":
        assert noise.std().item() == pytest.approx(1, abs=0.02)
        assert size.max() > 3
    else:
        assert size.max() <= 0.8 * (1 + 1e-6)
        # The squash is the actor's: bound * tanh(|x|) for a number x from N(0, 1).
        z = noise[..., problem.act_layout.slice("z")]
        x = torch.randn(100_000, generator=torch.Generator().manual_seed(0))
        expected = 0.8 * x.abs().tanh().mean()
        assert z.abs().mean().item() == pytest.approx(expected.item(), rel=0.02)


def test_a_soft_bound_is_paid_for(problem):
    agent = problem.agent("standard", bound_penalty=0.5, noise_bound=1.0, dtype=torch.float64)
    batch = problem.batch(8, dtype=torch.float64)
    noise = 2 * torch.randn(
        8, agent.noise_layout.dim, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    q, log_prob = batch.reward.expand(2, -1), batch.reward
    size = norms(problem, agent.chunk(noise))
    excess = (size - 1).clamp(min=0).square().sum((1, 2)).mean()
    expected = (agent.alpha * log_prob - q[0]).mean() + 0.5 * excess
    assert excess > 1
    assert agent.actor_loss(q, noise, log_prob, batch).item() == pytest.approx(expected.item())
    hard = problem.agent("standard", noise_bound=1.0, dtype=torch.float64)
    assert hard.actor_loss(q, noise, log_prob, batch).item() == pytest.approx(
        expected.item() - 0.5 * excess.item()
    )


@pytest.mark.long
def test_noise_may_exceed_a_soft_bound_and_comes_back(problem):
    """The critics ask for more and more noise; the price of the excess grows faster."""

    class Greedy(AGENTS.get("standard")):
        def actor_loss(self, q, noise, log_prob, batch):
            return super().actor_loss(0 * q, noise, log_prob, batch) - noise.sum(1).mean()

    def size(**options):
        agent = Greedy(
            problem.context(),
            Greedy.Options(**{**problem.options, "lr": 1e-2, "noise_bound": 1.0, **options}),
        )
        for seed in range(200):
            agent.update(problem.batch(seed=seed))
        return norms(problem, agent.act(problem.batch().obs, deterministic=True))

    soft, softer, hard = size(bound_penalty=1.0), size(bound_penalty=0.1), size()
    scalars = [
        i for i, block in enumerate(problem.act_layout.blocks) if block.stop == block.start + 1
    ]
    # Where 1 = 2 * penalty * excess: half a unit beyond the bound, and five.
    assert (soft[..., scalars] - 1.5).abs().max() < 0.25
    assert softer[..., scalars].min() > 2
    assert hard.max() <= 1


def test_log_probabilities_of_a_soft_bound_are_those_of_a_gaussian(problem):
    agent = problem.agent("standard", bound_penalty=0.5, initial_output=1.0)
    obs = problem.batch().obs
    mean, log_scale = agent.moments(obs)
    noise, log_prob = agent.sample(obs)
    scale = agent.distribution._spread(log_scale.exp())
    expected = torch.distributions.Normal(mean, scale).log_prob(noise.flatten(1)).sum(1)
    torch.testing.assert_close(log_prob, expected, rtol=1e-4, atol=1e-3)
    assert torch.equal(agent.act(obs, deterministic=True).flatten(1), mean)


# Presets.

REFUSED = {
    **{
        (name, preset): "its critic is sampler"
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
    "n_step": 1,
    "warmup_noise": "gaussian",
    "utd": 20 / 4,  # 20 updates after each step of four environments
}
CALLS = 20  # updates of action critic and actor in one call; then 10 of the noise critic
EXECUTED = 4


@pytest.mark.parametrize(
    ("preset", "own"),
    [
        (
            "dsrl",  # Transport
            {"critic": "noise", "width": 128, "noise_bound": 1.0, "warmup": 640_000 // EXECUTED},
        ),
        (
            "dsrl-na",  # Can
            {
                "critic": "aliased",
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
@pytest.mark.parametrize("name", [name for name in TRAINED if (name, "dsrl") not in REFUSED])
def test_presets_are_the_published_settings(name, preset, own):
    options = AGENTS.get(name).Options(**preset_options(preset, name, AGENTS.get(name).Options))
    found = {key: getattr(options, key) for key in DSRL | own}
    assert found == DSRL | own
    assert options.first_update == options.warmup
    assert math.isclose(options.utd * 4, 20)


@pytest.fixture
def tuned_folder(tmp_path, monkeypatch):
    """Where ``tuned.toml`` is read from."""
    monkeypatch.setattr(presets, "FOLDER", tmp_path)
    return tmp_path


class Quick(StandardAgent):
    name = "quick"
    Options = SacOptions


def test_tuned_options_are_the_defaults(tuned_folder):
    (tuned_folder / "tuned.toml").write_text("[quick]\nlr = 0.125\ncritics = 3\n")
    kind = presets.tuned(type("Quick", (Quick,), {"__module__": __name__, "__qualname__": "Quick"}))
    options = kind.Options()
    assert isinstance(options, SacOptions)
    assert vars(options) == {**vars(SacOptions()), "lr": 0.125, "critics": 3}
    assert kind.Options(lr=0.5).lr == 0.5
    assert Quick.Options().lr == SacOptions().lr
    with pytest.raises(UserError, match="lr must be positive"):
        kind.Options(lr=0)


def test_tuned_refuses_an_option_that_the_agent_does_not_have(tuned_folder):
    (tuned_folder / "tuned.toml").write_text("[quick]\nlearning_rate = 0.125\n")
    with pytest.raises(UserError, match="no option of quick 'learning_rate'"):
        presets.tuned(Quick)


@pytest.mark.parametrize("name", AGENTS.builtin)
def test_agents_have_what_was_chosen_for_them_and_travel_to_other_processes(name):
    options = AGENTS.get(name).Options()
    chosen = preset_options("tuned", name, type(options))
    assert {key: getattr(options, key) for key in chosen} == chosen
    assert pickle.loads(pickle.dumps(options)) == options


def test_tuned_agents_have_defaults_of_their_own():
    for name in tomllib.loads((presets.FOLDER / "tuned.toml").read_text()):
        kind = AGENTS.get(name)
        assert kind.Options.__qualname__ == f"{kind.__qualname__}.Options", name


@pytest.mark.parametrize(("plan", "agents"), [("core", 5)])
def test_what_tuning_chose_is_the_committed_choice(plan, agents):
    """Of all agents that a plan tuned, and to the digits that the preset has."""
    trials = json.loads((RESULTS / "tuning" / f"{plan}.json").read_text())
    for choice in trials["chosen"]:
        chosen = preset_options("tuned", choice["agent"], AGENTS.get(choice["agent"]).Options)
        assert chosen.keys() == choice["options"].keys()
        for name, value in choice["options"].items():
            wanted = pytest.approx(value, rel=1e-3) if isinstance(value, float) else value
            assert chosen[name] == wanted, name
    assert len(trials["chosen"]) == agents


def test_the_control_has_the_settings_of_the_agent_that_it_controls():
    wrong, right = (AGENTS.get(name).Options() for name in ("wrong-group", "equivariant"))
    assert vars(wrong) == vars(right)


def test_the_page_names_every_agent_option_and_preset():
    kinds = [AGENTS.get(name).Options for name in AGENTS.builtin]
    options = [field.name for kind in kinds for field in dataclasses.fields(kind)]
    for name in {*AGENTS.builtin, *PRESETS, *options}:
        assert f"`{name}`" in PAGE, name


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
