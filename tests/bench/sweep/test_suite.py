"""Suites as data: products, defaults, mistakes."""

import json
import re
from dataclasses import replace

import pytest

from symsteer.agents import AGENTS
from symsteer.agents.presets import preset_options
from symsteer.bench.runs.base_policy import find_base
from symsteer.bench.runs.config import build_config
from symsteer.bench.sweep.command import preview
from symsteer.bench.sweep.grid import SUITES, read_suite, suite_names
from symsteer.bench.sweep.plan import BASIC, make_plan
from symsteer.bench.sweep.schedule import tasks_of
from symsteer.bench.sweep.suite import load_suite
from symsteer.bench.sweep.workforce import THIS_MACHINE
from symsteer.bench.tasks import task_class
from symsteer.errors import UserError
from symsteer.leaderboard.keys import Key
from symsteer.leaderboard.paths import RECORDS, RESULTS
from symsteer.leaderboard.records import read_record
from symsteer.leaderboard.study import read_study
from symsteer.policies.files import load_policy
from tests.marks import need, policy_class


def write(tmp_path, text: str) -> str:
    path = tmp_path / "suite.toml"
    path.write_text(text)
    return str(path)


def test_the_grid_is_a_product_over_shared_settings(tmp_path):
    suite = load_suite(
        write(
            tmp_path,
            """
            description = "two by two"
            [grid]
            agent = ["base", "standard"]
            seed = [3, 4]
            [run]
            env_steps = 77
            [run.agent]
            gamma = 0.9
            [run.policy]
            steps = 7
            """,
        )
    )
    assert [(c.agent, c.seed) for c in suite.runs] == [
        ("base", 3),
        ("base", 4),
        ("standard", 3),
        ("standard", 4),
    ]
    assert {c.env_steps for c in suite.runs} == {77}
    assert {c.policy.steps for c in suite.runs} == {7}
    # The base policy without an agent has no gamma.
    standard = suite.runs[2]
    assert standard.agent_options.gamma == 0.9
    assert standard.agent_options.width == build_config({}, "").agent_options.width


@pytest.mark.parametrize(
    "name",
    [pytest.param(n, marks=[pytest.mark.slow] * (n in ("cpu", "full"))) for n in suite_names()],
)
def test_every_suite_that_ships_can_be_read_and_its_policies_made(name):
    suite = load_suite(name)
    assert suite.description
    # `symsteer list` counts the runs without building them.
    assert len(suite.runs) == read_suite(name)[0].count > 0
    # A base policy that cannot be made would be found hours later.
    for task_name, policy_name, options in {(c.task, c.policy_name, c.policy) for c in suite.runs}:
        task = task_class(task_name)
        policy_class(policy_name)(options, task.observation_layout, task.action_layout)


def test_the_suite_first_describes_its_records():
    """Its records are of one base policy, unlike those of suites that name no policy seed."""
    recorded = {}
    for path in RESULTS.glob("first/*.json"):
        config = json.loads(path.read_text())["config"]
        recorded[tuple(config[key] for key in BASIC)] = config
    for run in load_suite("first").runs:
        plain = run.to_json()
        config = recorded.pop(tuple(plain[key] for key in BASIC))
        # Options that did not exist, or exist no longer, cannot be compared.
        for mine, theirs in (
            (plain, config),
            (plain["policy"], config["policy"]),
            (plain["evaluation"], config["evaluation"]),
            (plain["agent_options"], {**config["sac"], "target_entropy": -0.5}),
        ):
            shared = mine.keys() & theirs.keys() - {"policy", "evaluation"}
            assert {key: mine[key] for key in shared} == {key: theirs[key] for key in shared}
        # None was minus half a nat for each number of the noise; now it is given per number.
        assert config["sac"]["target_entropy"] is None
        assert config["policy_seed"] == config["demonstrations"]["seed"] == 0
    # This agent was replaced.
    assert {key[BASIC.index("agent")] for key in recorded} == {"approximate"}


def test_the_suite_second_runs_what_its_study_claims():
    runs = load_suite("second").runs
    claims = read_study("second").claims
    for claim in claims:
        for cells in filter(None, (claim.cells, claim.minus)):
            of = [
                run
                for run in runs
                if (cells.variant is None or {run.variant, "none"} & set(cells.variant))
                and run.env_steps in (cells.env_steps or [run.env_steps])
                and run.embodiment in (cells.embodiment or [run.embodiment])
                and run.task in (cells.task or [run.task])
            ]
            assert set(cells.variant or ()) <= {run.variant for run in of}, claim.name
            for agent in claim.agents:
                policies = {(r.task, r.seed) for r in of if r.agent == agent}
                assert len(policies) >= 5, (claim.name, agent)
    # No policy and no seed on which settings were chosen, and every policy for all agents.
    assert {run.seed for run in runs} == set(range(20, 30)) - {24}
    assert not {"StackCube-v1", "PokeCube-v1"} & {run.task for run in runs}


def test_the_zoo_is_compared_in_cells_of_the_suite_second():
    zoo, second = load_suite("zoo").runs, load_suite("second").runs

    def cell(run):
        return replace(run, agent="base", agent_options=AGENTS.get("base").Options())

    assert {cell(run) for run in zoo} <= {run for run in second if run.agent == "base"}
    claimed = {agent for claim in read_study("zoo").claims for agent in claim.agents}
    others = {"standard", "equivariant", "residual-pathway", "best-of-n-kernel"}  # this is no more
    assert {run.agent for run in zoo} == claimed - others


def test_a_submission_steers_the_base_policies_of_the_committed_runs():
    """A new option of policies gives the folders of base policies other names: rename them then."""
    steered, policies = {}, {}
    for path in RECORDS.glob("second/*-standard-*.json"):
        record = read_record(path)
        steered[Key.of(record), record.settings.seed] = record.base_policy.content_hash
    second = load_suite("second").runs
    for run in load_suite("submission").runs:
        assert run in second
        place = run.task, run.embodiment, run.seed
        if place not in policies:
            folder = find_base(run, RESULTS)
            assert folder is not None, place
            policies[place] = load_policy(folder).content_hash()
        (key,) = (
            key
            for key, seed in steered
            if seed == run.seed
            and (key.task, key.variant, key.embodiment) == (run.task, run.variant, run.embodiment)
            and (key.env_steps, key.demonstrations) == (run.env_steps, run.demonstrations.count)
        )
        assert policies[place] == steered[key, run.seed]


def test_agents_and_variants_of_a_seed_share_its_base_policy(tmp_path):
    grid = """
        [grid]
        agent = ["zero", "equivariant"]
        variant = ["none", "wind:1"]
        "policy.name" = ["edp", "plain"]
        seed = [2, 3]
    """

    def shared(text: str) -> list[str]:
        plan = make_plan(load_suite(write(tmp_path, text)), tmp_path)
        # The seeds are not repeated in the runs' labels.
        assert all(list(run.extra) == ["policy.name"] for run in plan.runs)
        return [task.kind for task in tasks_of(plan, plan.runs) if task.kind != "run"]

    assert shared(grid) == ["demonstrations"] * 2 + ["base policy"] * 4
    one = "[run]\npolicy_seed = 7\ndemonstrations.seed = 7"
    assert shared(grid + one) == ["demonstrations"] + ["base policy"] * 2


def test_an_option_applies_to_the_agents_that_have_it(tmp_path):
    text = """
        [grid]
        agent = ["zero", "standard", "residual-pathway"]
        "agent.penalty" = [0.2, 0.4]
        [run.agent]
        preset = "first"
        gamma = 0.9
        [run.agent.standard]
        gamma = 0.8
    """
    runs = load_suite(write(tmp_path, text)).runs
    # A value that changes nothing for an agent does not repeat its run.
    assert [c.agent for c in runs] == ["zero", "standard", "residual-pathway", "residual-pathway"]
    assert [c.agent_options.gamma for c in runs[1:]] == [0.8, 0.9, 0.9]
    assert [c.agent_options.penalty for c in runs[2:]] == [0.2, 0.4]
    preset = preset_options("first", "standard", type(runs[1].agent_options))
    for key in set(preset) - {"gamma"}:
        assert getattr(runs[1].agent_options, key) == preset[key]


def test_a_grid_may_set_one_agent_only_and_choose_presets_and_policies(tmp_path):
    text = """
        [grid]
        agent = ["standard", "equivariant"]
        "agent.standard.width" = [32, 64]
        "policy.name" = ["edp", "plain"]
        [run]
        agent = "residual-pathway"
    """
    runs = load_suite(write(tmp_path, text)).runs
    default = build_config({"agent": "equivariant"}, "").agent_options.width
    assert [(c.agent, c.agent_options.width, c.policy_name) for c in runs] == [
        ("standard", 32, "edp"),
        ("standard", 32, "plain"),
        ("standard", 64, "edp"),
        ("standard", 64, "plain"),
        ("equivariant", default, "edp"),
        ("equivariant", default, "plain"),
    ]


def test_options_in_which_runs_differ_are_shown(tmp_path):
    """Also where another agent of the suite does not have the option."""
    text = """
        [grid]
        agent = ["zero", "residual-pathway"]
        "agent.penalty" = [0.2, 0.4]
    """
    plan = make_plan(load_suite(write(tmp_path, text)), tmp_path)
    assert [run.extra for run in plan.runs] == [
        {},
        {"agent.penalty": 0.2},
        {"agent.penalty": 0.4},
    ]
    assert "residual-pathway penalty 0.2 seed 0" in plan.runs[1].label
    assert re.search(r"agent.penalty +0.2 +1 +0", preview(plan, THIS_MACHINE))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[grid]\nagnt = ['base']", "did you mean 'agent'"),
        ("[run.agent]\ngama = 0.9", "agent equivariant: .* did you mean 'gamma'"),
        ("[grid]\nagent = ['zero']\n'agent.gamma' = [0.9]", "agent zero: .* 'gamma'"),
        ("[grid]\nagent = ['zero']\n[run.agent.standard]\ngamma = 0.9", "no agent 'standard'"),
        ("[run.agent.equivariant]\npenalty = 1", "agent equivariant: there is no"),
        ("[run.agent]\nname = 'equivarant'", "did you mean 'equivariant'"),
        ("[run.agent]\npreset = 'frist'", "did you mean 'first'"),
        ("[run.agent]\npreset = 1", "agent.preset must be a text"),
        ("[grid]\n'agent.gamma.more' = [1]", "no agent 'gamma'"),
        ("[run]\npolicy = 3", "run.policy must be a name or a table"),
        ("[run.policy]\nwidht = 3", "policy edp: .* did you mean 'width'"),
        ("[grid]\n'policy.name' = ['plian']", "did you mean 'plain'"),
        ("[run]\nenv_steps = 'many'", "env_steps"),
        ("[run]\nagent = 3", "must be a name or a table"),
        ("[grid]\nseed = []", "grid 1 seed: List should have at least 1 item"),
        ("[run]\nenv_steps = 0", "greater than or equal to 1"),
        ("[run]\nseed = 2026-01-31", "seed: Input should be a valid integer"),
        ("[run.agent]\nlr = inf", "lr is inf"),
        (f"[grid]\nseed = {list(range(1000))}\nnum_envs = {list(range(1000))}", "has 1000000 runs"),
        ("grid = []", "has no runs"),
        ("colour = 'red'", "there is no key 'colour'"),
    ],
)
def test_mistakes_in_a_suite(text, words, tmp_path):
    with pytest.raises(UserError, match=words):
        load_suite(write(tmp_path, text))


def test_how_a_toml_file_is_read(tmp_path):
    """Suites, plans, presets and studies have one reader."""
    content, path = (SUITES / "smoke.toml").read_bytes(), tmp_path / "mine.toml"
    path.write_bytes(b"\xef\xbb\xbf" + content.replace(b"\n", b"\r\n"))
    assert read_suite(str(path))[0] == read_suite("smoke")[0]
    for wrong in (b"not toml", content.decode().encode("utf-16"), b"\xff", b"a = " + b"[" * 5000):
        path.write_bytes(wrong)
        with pytest.raises(UserError, match=f"the suite {path} cannot be read as TOML: .*correct"):
            read_suite(str(path))
    path.unlink()
    with pytest.raises(UserError, match=f"there is no suite '{path}'; .*valid: ablations"):
        read_suite(str(path))
    path.mkdir()
    with pytest.raises(UserError, match=f"the suite {path} cannot be read: Is a dir.*name another"):
        read_suite(str(path))
    need("tune")
    from symsteer.bench.tuning.plan import read_plan

    for read, kind in ((load_suite, "suite"), (read_plan, "tuning plan"), (read_study, "study")):
        with pytest.raises(UserError, match=f"there is no {kind} 'dmeo'"):
            read("dmeo")


def test_strengths_may_begin_at_zero(tmp_path):
    text = "[grid]\nvariant = ['action_gain', 'wind']\nstrength = [0, 0.5]"
    suite = load_suite(write(tmp_path, text))
    assert [c.variant for c in suite.runs] == ["none", "action_gain:0.5", "wind:0.5"]
