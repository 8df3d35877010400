"""Reading tuning plans: what they mean, and mistakes."""

# ruff: noqa: E402
from __future__ import annotations

import itertools

import pytest

from tests.marks import need

need("tune")
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from symsteer.agents import AGENTS
from symsteer.bench.runs.config import RunConfig
from symsteer.bench.sweep.grid import read_suite, suite_names
from symsteer.bench.tuning import plan_summaries
from symsteer.bench.tuning.plan import read_plan
from symsteer.errors import UserError
from tests.bench.tuning.tiny_plan import TEXT, write_plan


def test_agents_share_a_space_and_have_their_own_options(tmp_path):
    plan = read_plan(write_plan(tmp_path))
    shared = {
        "lr": FloatDistribution(1e-4, 1e-1, log=True),
        "batch_size": CategoricalDistribution((32, 64)),
    }
    assert plan.spaces["standard"] == shared
    assert plan.spaces["equivariant"] == {**shared, "critics": IntDistribution(2, 6)}
    assert plan.first("equivariant") == {"lr": 6e-4, "batch_size": 64, "critics": 2}
    default = AGENTS.get("equivariant").Options().lr
    assert default != 6e-4
    plan = read_plan(write_plan(tmp_path, TEXT.replace("lr = 6e-4\n", "")))
    assert plan.first("equivariant") == {"lr": default, "batch_size": 64, "critics": 2}
    given = TEXT + "\n[[further]]\nlr = 1e-2\ncritics = 4\n"
    plan = read_plan(write_plan(tmp_path, given))
    assert plan.later("standard") == [{"lr": 1e-2, "batch_size": 64}]
    assert plan.later("equivariant") == [{"lr": 1e-2, "batch_size": 64, "critics": 4}]


def test_a_shared_option_is_for_those_who_have_it_and_can_be_taken_from_one(tmp_path):
    text = TEXT.replace('"standard", ', '"standard", "best-of-n", ')
    text += "[space.standard]\nbatch_size = []\n[space.best-of-n]\nlr = []\nnoise_bank = [8, 16]\n"
    plan = read_plan(write_plan(tmp_path, text))
    assert {agent: list(space) for agent, space in plan.spaces.items()} == {
        "standard": ["lr"],
        "best-of-n": ["batch_size", "noise_bank"],
        "equivariant": ["lr", "batch_size", "critics"],
    }


def test_cells_are_runs_with_the_options(tmp_path):
    plan = read_plan(write_plan(tmp_path, TEXT + "[run.agent]\ntau = 0.1\n"))
    cells = plan.cells("equivariant", {"lr": 0.01, "critics": 3})
    assert [cell.variant for cell in cells] == ["none", "action_gain:1"]
    assert {cell.agent for cell in cells} == {"equivariant"}
    options = cells[0].agent_options
    assert (options.lr, options.critics, options.tau) == (0.01, 3, 0.1)
    assert [cell.seed for cell in plan.cells("standard", {}, "confirm")] == [2, 3]


def test_no_cell_of_a_plan_is_on_a_leaderboard():
    """Tuned settings would have an advantage there."""
    shown, defaults = set(), RunConfig().to_json()
    for suite in set(suite_names()) - {"full", "smoke"}:
        for table in itertools.chain(*read_suite(suite)[0].tables):
            run = {**defaults, "policy_seed": table.get("seed", 0), **table}
            shown.add((run["task"], run["embodiment"], run["policy_seed"]))
    for name, description in plan_summaries().items():
        plan = read_plan(name)
        assert description == plan.description != ""
        agent = plan.agents[0]
        for grid in ("grid", "confirm"):
            cells = plan.cells(agent, plan.first(agent), grid)
            assert not shown & {(c.task, c.embodiment, c.policy_seed) for c in cells}


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("trials = 12", "trails = 12", "'trails'.*did you mean 'trials'"),
        ("trials = 12", "trials = 0", "trials: Input should be greater than or equal to 1"),
        ("trials = 12", "trials = true", "trials: Input should be a valid integer"),
        ("[confirm]\nseed = [2, 3]", "", "confirm: Field required"),
        ('"standard", ', '"standrad", ', "did you mean 'standard'"),
        ("batch_size =", "batchsize =", "did you mean 'batch_size'"),
        ("[32, 64]", "64", "space.batch_size must be a list of choices, or { low"),
        (
            "[32, 64]",
            "[16, 32]",
            "space.batch_size does not contain 64, with which the first trial of standard",
        ),
        ("low = 1e-4, high = 1e-1", "low = 1e-1, high = 1e-4", "with low below high"),
        ("low = 1e-4", "low = 0.0", "above 0 with log"),
        ("low = 1e-4", "lowest = 1e-4", "space.lr must be a list of choices"),
        ("low = 1e-4", "low = nan", "agent option lr must be positive, not nan"),
        ("high = 1e-1", 'high = "1e-1"', "space.lr must be a list of choices"),
        ("lr = 6e-4", "lr = [1]", "space: agent_options.lr: Input should be a valid num"),
        ("[32, 64]", "[32, 64.5]", "tiny.toml: space: agent_options.batch_size: Input should be"),
        (
            "[space.equivariant]\ncritics =",
            "equivariant = [1]\n#",
            "space.equivariant must be a table",
        ),
        ("[start]", "agent = 1\n[start]", "run.agent.standard must be a table"),
        ("[start]", "agent.standard = 1\n[start]", "run.agent.standard must be a table"),
        ('["standard", "equivariant"]', "1", "agents: Input should be a valid tuple"),
        ("[32, 64]", "[-1, 64]", "batch_size"),
        ("probe = 1", "probe = 3", "probe is 3, but there are only 2 cells"),
        ('"none", ', '"noone", ', "noone"),
        (
            "probe = 1",
            'singles = ["standart"]',
            "singles: there is no agent 'standart'; did you mean 'standard'",
        ),
        ("[space]", "[[further]]\nlr = 1.0\n[space]", "does not contain 1.0 of a further setting"),
        ("[space]", "[[further]]\nlrr = 1.0\n[space]", "further.*'lrr'; did you mean 'lr'"),
    ],
)
def test_mistakes(tmp_path, old, new, message):
    assert old in TEXT
    path = write_plan(tmp_path, TEXT.replace(old, new))
    with pytest.raises(UserError, match=message) as refused:
        read_plan(path)
    assert "\n" not in str(refused.value)
