"""`symsteer advise`: worlds by name and from an audit; mistakes."""

from __future__ import annotations

import json

import pytest

from symsteer.leaderboard import paths
from symsteer.leaderboard.records import write_record
from tests.leaderboard.record_factory import steered
from tests.leaderboard.test_defects import CELL

VARIANTS = {"none": 0.9, "action_gain:0.5": 0.7, "action_gain:1": 0.2}
TASKS = ("PickCube-v1", "PushCube-v1", "StackCube-v1", "PullCube-v1")


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    """Runs of four audited tasks, in which symmetry helps only while the world is symmetric."""
    folder = tmp_path_factory.mktemp("records")
    for task in TASKS:
        rates = {variant: (0.5, rate, 0.5) for variant, rate in VARIANTS.items()}
        for record in steered(rates, task=task):
            write_record(record, folder / task / f"{record.run_id}.json")
    return folder


@pytest.fixture
def advise(records, command):
    return lambda *arguments: command("advise", *arguments, "--runs", records)


def test_a_world_by_name(advise):
    world = ("--task", "PushT-v1", "--variant", "action_gain:0.25")
    code, shown = advise(*world)
    assert code == 0
    found = json.loads(advise(*world, "--json")[1].out)
    assert "PushT-v1, floating, action_gain:0.25, C8" in shown.out
    assert "committed audit" in shown.out
    (data,) = found["advice"]
    (one,) = [
        e for e in data["expected"] if (e["agent"], e["measure"]) == ("equivariant", "success")
    ]
    assert (one["source"], one["kind"], one["tasks"]) == ("other tasks", "action_gain", 4)
    assert 0.1 < one["value"] < 0.5
    assert f"{one['value']:+.3f} [" in shown.out
    assert "success: take equivariant" in shown.out
    (test,) = found["left_out"]
    assert len(test["tasks"]) == 4
    assert "by success in 12/12 cells (the agent that is best" in shown.out
    header, row = shown.out.partition("Test: each task")[2].splitlines()[1:3]
    assert row.index("equivariant") == header.index("Agent")


def test_worlds_of_an_audit(advise, tmp_path):
    worlds = [
        CELL | {"task": "Mine-v1", "variant": variant, "decision": [x, x, x], "part": "tool"}
        for variant, x in (("action_gain:0.1", 0.1), ("shelf:0.5", 0.2))
    ]
    (tmp_path / "summary.json").write_text(json.dumps(worlds))
    code, shown = advise("--audit", tmp_path)
    assert code == 0
    assert "Mine-v1, floating, action_gain:0.1, C8" in shown.out
    # The task and its dial are unknown here, and one dial is not enough for a part.
    assert "kind of break         shelf or else part tool" in shown.out
    assert "success: undecided, because" in shown.out
    assert shown.out.count("Test: each task from") == 1


@pytest.mark.long
def test_the_file_of_one_audit(advise, tmp_path, command):
    small = ("--base-policy", "none", "--states", 8, "--out", tmp_path)
    code, _ = command("audit", "--task", "PushCube-v1", "--variant", "wind:0.3", *small)
    assert code == 0
    for path in (tmp_path, tmp_path / "audit.json"):
        code, shown = advise("--audit", path)
        assert code == 0
        assert "PushCube-v1, floating, wind:0.3, C8" in shown.out


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "name one world"),
        (("--task", "PushT-v1", "--audit", "x"), "name one world"),
        (("--task", "PushTea-v1"), "did you mean 'PushT-v1'"),
        (("--task", "PushT-v1", "--variant", "wnid:1"), "did you mean 'wind'"),
        (("--task", "PushT-v1", "--variant", "wind"), "wind"),
        (("--task", "all"), "not all"),
        (("--task", "PushT-v1", "--embodiment", "hand"), "hand"),
        (("--task", "PushT-v1", "--variant", "wind:0.33"), "symsteer audit --task PushT-v1"),
        (("--audit", "nowhere"), "cannot read nowhere"),
        (("--audit", "."), "holds no audit"),
    ],
)
def test_mistakes(advise, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    code, shown = advise(*arguments)
    assert (code, shown.out) == (2, "")
    assert words in shown.err
    assert shown.err.count("\n") == 1


def test_an_installed_package_has_no_committed_records(tmp_path, monkeypatch, command):
    monkeypatch.setattr(paths, "RECORDS", tmp_path / "nothing")
    code, shown = command("advise", "--task", "PushT-v1")
    assert code == 2
    assert "name run folders: symsteer advise --runs RUNS" in shown.err
