"""The study of base policies: every cell once, shared demonstrations, a table that adds up."""

import dataclasses
import json

import pytest

from symsteer.bench.cli import base
from symsteer.bench.runs import base_study
from symsteer.bench.runs.base_study import study, table, write_study
from symsteer.errors import UserError
from symsteer.policies import POLICIES
from tests.bench.tiny_run import POLICY, tiny_config


def tiny_policies(*names):
    return {name: POLICIES.get(name).Options(**POLICY) for name in names}


@pytest.mark.slow
def test_a_small_study(tmp_path):
    policies, counts = tiny_policies("edp", "plain-augmented"), (2,)
    rows = study([tiny_config()], tmp_path, policies, counts, seeds=1, episodes=4, workers=1)
    assert [(r["name"], r["count"], r["seed"]) for r in rows] == [
        (name, count, 0) for count in counts for name in policies
    ]
    assert all(r["success"] == r["successes"] / 4 for r in rows)
    symmetric, plain = rows
    assert symmetric["equivariance_error"] < 1e-4 < 0.01 < plain["equivariance_error"]
    for row in rows:
        assert 0 <= row["zero"] <= 1
        assert 0 <= row["solvable"] <= 1
        assert row["action_std"] > 0
        assert 0 < row["jumps"]["median"] < row["jumps"]["high"] < 1
    assert len(list((tmp_path / "base").glob("*.h5"))) == 1
    # A policy is trained once: its times would differ.
    more = study([tiny_config()], tmp_path, policies, counts, seeds=2, episodes=4, workers=1)
    assert [row for row in more if row["seed"] == 0] == rows
    assert len(more) == 2 * len(rows)
    # Other settings are another policy.
    wider = {"edp": dataclasses.replace(policies["edp"], width=24)}
    (other,) = study([tiny_config()], tmp_path, wider, counts, seeds=1, episodes=4, workers=1)
    assert other["parameters"] > symmetric["parameters"]
    write_study(tmp_path / "study.json", tiny_config(), policies, rows)
    written = json.loads((tmp_path / "study.json").read_text())
    assert written["rows"] == rows
    assert {name: options["width"] for name, options in written["policies"].items()} == {
        "edp": 16,
        "plain-augmented": 16,
    }


@pytest.mark.slow
def test_joint_policies_are_trained_once_for_all_tasks(tmp_path):
    configs = [tiny_config(task=task) for task in ("PushCube-v1", "PickCube-v1")]
    policies = tiny_policies("edp", "edp-joint")
    rows = study(configs, tmp_path, policies, (2,), seeds=1, episodes=4, workers=1)
    seconds = {(r["name"], r["task"]): r["training_seconds"] for r in rows}
    assert len(seconds) == len(rows) == 4
    assert seconds["edp-joint", "PushCube-v1"] == seconds["edp-joint", "PickCube-v1"]


def test_the_command_gives_each_policy_its_own_defaults(tmp_path, monkeypatch):
    given = {}

    def recorded(configs, out, policies, *numbers):
        given.update(policies)
        return [{"name": n, "count": 5, "task": "Push", "success": 0.5} for n in policies]

    monkeypatch.setattr(base_study, "study", recorded)
    assert base(policies=("edp", "spherical"), demonstrations=(5,), out=tmp_path) == 0
    assert given == {name: POLICIES.get(name).Options() for name in ("edp", "spherical")}
    assert given["edp"].width != given["spherical"].width


def test_the_table_gives_mean_and_range():
    rows = [
        {"name": "edp", "count": 5, "seed": s, "success": value / shrink, "task": task}
        for task, shrink in (("Push", 1), ("Pick", 2))
        for s, value in enumerate((0.2, 0.4, 0.9))
    ]
    assert table(rows).splitlines()[-2:] == [
        "| `Pick` | 5 | 0.25 [0.10, 0.45] |",
        "| `Push` | 5 | 0.50 [0.20, 0.90] |",
    ]


def test_impossible_numbers_are_refused(tmp_path):
    edp = tiny_policies("edp")
    with pytest.raises(UserError, match="positive"):
        study([tiny_config()], tmp_path, edp, (0,), seeds=1, episodes=1, workers=1)
    for policies, counts in (({}, (3,)), (edp, ())):
        with pytest.raises(UserError, match="at least one"):
            study([tiny_config()], tmp_path, policies, counts, seeds=1, episodes=1, workers=1)
