"""Every base policy can be steered on a task."""

import dataclasses

import pytest

from symsteer.bench.runs.run import execute
from symsteer.leaderboard.records import read_record
from symsteer.policies import POLICIES
from tests.bench.tiny_run import tiny_config
from tests.marks import slow_except

MARKS = {"canonical": pytest.mark.long, "spherical": pytest.mark.long}
NAMES = [
    pytest.param(name, marks=MARKS.get(name, pytest.mark.slow))
    for name in POLICIES.builtin
    if name != "edp"
]


@pytest.mark.parametrize("name", NAMES)
def test_it_is_trained_and_steered(name, tmp_path):
    evaluation = dataclasses.replace(tiny_config().evaluation, every=160)
    config = tiny_config(policy_name=name, env_steps=160, evaluation=evaluation)
    record = read_record(execute(config, tmp_path, progress=False) / "record.json")
    assert record.status == "finished"
    assert record.base_policy.name == name
    assert record.budget.updates > 0


TILTED = ["TiltedPickCube-v1", "TiltedPushCube-v1"]


@pytest.mark.long
@pytest.mark.parametrize("task", slow_except(TILTED, TILTED[0]))
def test_the_spherical_policy_is_steered_on_a_tilted_table(task, tmp_path):
    """An equivariant agent uses the turns about the laboratory's vertical, all of them exact."""
    config = tiny_config(policy_name="spherical", task=task, env_steps=160)
    record = read_record(execute(config, tmp_path, progress=False) / "record.json")
    assert record.status == "finished"
    assert (record.base_policy.name, record.base_policy.group) == ("spherical", "C8")
    assert record.budget.updates > 0
