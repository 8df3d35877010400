"""The command that repeats a run gives its configuration again."""

from __future__ import annotations

import shlex

import pytest

from symsteer.bench.runs.arguments import parse_run
from symsteer.bench.runs.config import RunConfig, build_config
from symsteer.leaderboard.paths import RESULTS
from symsteer.leaderboard.records import config_hash, read_record
from symsteer.leaderboard.records.repeat import DERIVED, FILES, KEYS, repeat_command
from symsteer.leaderboard.records.retired import RETIRED
from tests.bench.tiny_run import tiny_config

LEARNERS = RESULTS / "learners"


def again(command: str | None) -> RunConfig:
    assert command is not None
    program, verb, *arguments = shlex.split(command)
    assert (program, verb) == ("symsteer", "run")
    return parse_run(arguments)[0]


@pytest.mark.parametrize("agent", ["equivariant", "golden-ticket", "best-of-n"])
def test_the_command_gives_the_configuration_again(agent: str) -> None:
    variant = "wind:0.2..0.8+action_gain:1@0.25..0.75"
    config = tiny_config(agent=agent, variant=variant, seed=3, checkpoint_every=7)
    resolved = config.to_json() | {"evaluation_variant": "wind:0.2..0.8", "files": {}}
    found = again(repeat_command(resolved))
    assert config_hash(found.to_json()) == config_hash(config.to_json())


def test_the_command_holds_every_option() -> None:
    """Also those that have their defaults: these may change."""
    config = RunConfig(policy_seed=7)
    words = shlex.split(repeat_command(config.to_json()) or "")
    for option in ("--policy-seed", "--agent.layer-norm", "--policy.hold", "--evaluation.every"):
        assert option in words
    assert again(shlex.join(words)) == config
    assert config.to_json().keys() == KEYS
    old = config.to_json()
    old["agent_options"] |= RETIRED
    assert "--agent.n-step" not in (repeat_command(old) or "")


def test_old_options_of_one_agent_are_left_out_where_they_mean_the_same() -> None:
    path = next((RESULTS / "dial-next").glob("PickCube-v1-floating-none-slow-s150-*.json"))
    options = read_record(path).config["agent_options"]
    options |= {"start": 0, "shared": False}  # as in later records
    config = RunConfig(agent="slow").to_json()
    assert "bias_speed" in options
    assert again(repeat_command(config | {"agent_options": options})).to_json() == config
    assert "--agent.start 1000" in (
        repeat_command(config | {"agent_options": {**options, "start": 1000}}) or ""
    )


@pytest.mark.parametrize("path", sorted(LEARNERS.glob("PickCube-v1-floating-none-*-s10-*.json")))
def test_committed_records(path) -> None:
    config = read_record(path).config
    if config["agent"] == "approximate":
        pytest.skip("SymSteer has this agent no more")
    expected = {key: value for key, value in config.items() if key not in DERIVED}
    # Options that were added since the run have their defaults.
    assert build_config(expected, "record").to_json() == again(repeat_command(config)).to_json()


def test_a_sentence_is_one_word_of_the_command() -> None:
    config = RunConfig(policy_name="edp-told")
    assert " --policy.instruction 'Pick up the cube " in (repeat_command(config.to_json()) or "")
    assert again(repeat_command(config.to_json())) == config
    policy = config.to_json()["policy"]
    for text in ("Push; rm -rf ~", "Push $(rm)", "Push\nrm", "--out=/tmp", "Push 'it'"):
        change = {"policy": policy | {"instruction": text}}
        assert repeat_command(config.to_json() | change) is None


def test_files_have_placeholders() -> None:
    resolved = RunConfig().to_json() | {"files": {"demonstrations": "0" * 64}}
    command = repeat_command(resolved)
    assert command is not None
    assert command.endswith(" ".join(FILES["demonstrations"]))
    assert repeat_command(resolved | {"files": {"else": "0"}}) is None


def test_no_command_for_what_no_option_takes() -> None:
    config = RunConfig().to_json()
    assert repeat_command(config) is not None
    for change in (
        {"task": "PickCube-v1; rm -rf ~"},
        {"task": "\x03rm"},
        {"task": "--out=/tmp/elsewhere"},
        {"out": "/tmp/elsewhere"},
        {"sac": {"width": 3}},
        {"agent_options": {"--x": 1}},
        {"agent_options": {"x": ["a b"]}},
        {"agent_options": None},
    ):
        assert repeat_command(config | change) is None, change
