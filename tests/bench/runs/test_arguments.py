"""The command line of ``symsteer run``: options of the named agent and policy."""

import pytest

from symsteer.bench.runs.arguments import parse_run
from symsteer.bench.runs.config import RunConfig, build_config
from symsteer.errors import UserError


def test_without_arguments_the_defaults_are_those_of_a_run():
    config, execution = parse_run([])
    assert config == RunConfig()
    assert (str(execution.runs), execution.sim_workers, execution.quiet) == ("runs", 1, False)


def test_options_of_the_named_agent_and_policy():
    words = "--policy.width 48 --agent=residual-pathway --agent.penalty 0.25 --policy.name plain"
    words += " --agent.no-layer-norm --task PushCube-v1 --evaluation.every 77 --runs a --quiet"
    words += " --agent=standard --agent residual-pathway"
    config, execution = parse_run(words.split())
    assert (config.agent, config.policy_name) == ("residual-pathway", "plain")
    assert config.agent_options.penalty == 0.25
    assert not config.agent_options.layer_norm
    assert config.policy == type(config.policy)(width=48)
    assert (config.task, config.evaluation.every) == ("PushCube-v1", 77)
    assert (str(execution.runs), execution.quiet) == ("a", True)


@pytest.mark.parametrize("preset", [[], ["--agent.preset", "first"]])
def test_base_policy_and_demonstrations_follow_the_runs_seed(preset):
    def seeds(*arguments: str) -> tuple[int, int, int]:
        config = parse_run([*arguments, *preset])[0]
        assert build_config(config.to_json(), "") == config
        return config.seed, config.policy_seed, config.demonstrations.seed

    assert seeds() == (0, 0, 0)
    assert seeds("--seed", "5") == (5, 5, 5)
    assert seeds("--seed", "5", "--policy-seed", "0") == (5, 0, 5)
    assert seeds("--demonstrations.seed", "2", "--seed", "5") == (5, 5, 2)


def test_what_a_policy_is_told_follows_the_runs_task():
    def told(*arguments: str) -> tuple[str, ...]:
        config = parse_run(["--policy.name", "edp-told", *arguments])[0]
        assert build_config(config.to_json(), "") == config
        return config.policy.instruction, *config.policy.tasks

    pull = "Pull the cube into the target."
    assert told("--task", "PullCube-v1") == (pull, "PullCube-v1")
    words = ("--task", "PullCube-v1", "--policy.tasks", "PushCube-v1", "--policy.instruction")
    assert told(*words, "Drag it.") == ("Drag it.", "PullCube-v1", "PushCube-v1")


def test_a_preset_replaces_defaults_and_explicit_options_win():
    preset = parse_run(["--agent.preset", "first"])[0].agent_options
    assert parse_run(["--agent.preset=first", "--agent.width", "31"])[0].agent_options == type(
        preset
    )(**{**vars(preset), "width": 31})
    # Of a preset, an agent without options takes nothing.
    assert parse_run(["--agent", "base", "--agent.preset", "first"])[0].agent == "base"


def test_help_shows_the_options_of_the_named_agent(capsys):
    shown = {}
    for agent in ("residual-pathway", "base"):
        with pytest.raises(SystemExit) as end:
            parse_run(["--agent", agent, "--help"])
        assert end.value.code == 0
        shown[agent] = capsys.readouterr().out
    for text in shown.values():
        assert "--agent STR" in text
        assert "--policy.width INT" in text
        assert "Parallel training environments." in text
    assert "--agent.penalty FLOAT" in shown["residual-pathway"]
    assert "Discount per decision" in shown["residual-pathway"]
    assert "--agent.gamma" not in shown["base"]


def test_unknown_options_name_the_nearest(capsys):
    with pytest.raises(SystemExit) as end:
        parse_run(["--agent", "residual-pathway", "--agent.penalti", "1"])
    assert end.value.code == 2
    assert "--agent.penalty" in capsys.readouterr().err
    with pytest.raises(UserError, match="did you mean 'residual-pathway'"):
        parse_run(["--agent", "residual-pathwy", "--help"])
