"""`symsteer advise`: worlds by name, by their kind and by a probe; mistakes."""

from __future__ import annotations

import json

import pytest

from symsteer.leaderboard import paths
from symsteer.leaderboard.records import write_record
from tests.leaderboard.record_factory import make_cell, with_policies

WORLDS = {
    "none": {"base": 0.2, "zero": 0.4, "golden-ticket": 0.4, "equivariant": 0.8, "standard": 0.5},
    "perception_bias:1": {
        **{"base": 0.2, "zero": 0.4, "golden-ticket": 0.6},
        **{"equivariant": 0.5, "standard": 0.8},
    },
}
TASKS = ("PickCube-v1", "PushCube-v1", "StackCube-v1")


def write(folder, records):
    for record in records:
        write_record(record, folder / f"{record.run_id}.json")
    return folder


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    """Three tasks in which symmetry helps while the world is symmetric."""
    folder = tmp_path_factory.mktemp("records")
    for task in TASKS:
        for variant, rates in WORLDS.items():
            write(folder / task, with_policies(make_cell(rates, variant=variant, task=task)))
    return folder


@pytest.fixture
def advise(records, command):
    return lambda *arguments: command("advise", *arguments, "--runs", records)


def told(shown):
    return {one["measure"]: one["agent"] for one in json.loads(shown.out)["advice"]}


def test_a_world_of_the_records(advise):
    code, shown = advise("--task", "PickCube-v1", "--variant", "perception_bias:1")
    assert code == 0
    assert "success: take standard\n  records  take standard" in shown.out
    assert "From 6 worlds of 3 tasks, of 1 study." in shown.out
    assert "  what would change these answers\n    records  more runs in this world" in shown.out


def test_rules_learn_from_the_other_tasks_alone(advise):
    world = ("--task", "PickCube-v1", "--variant", "perception_bias:0.5")
    found = json.loads(advise(*world, "--json")[1].out)
    assert {one["answers"]["kind"]["worlds"] for one in found["advice"]} == {2}


def test_a_world_that_no_record_has(advise):
    code, shown = advise("--task", "PushT-v1", "--variant", "perception_bias:0.5", "--json")
    assert code == 0
    assert told(shown) == {"auc": "standard", "success": "standard"}
    code, shown = advise("--broken-by", "none", "--json")
    assert told(shown) == {"auc": "equivariant", "success": "equivariant"}
    code, shown = advise("--broken-by", "wind")
    assert code == 0
    assert "success: take standard, because the rules refuse" in shown.out
    assert "play base, zero and golden-ticket" in shown.out


def test_a_probe_in_a_world_without_a_name(advise, tmp_path):
    rates = {"base": 0.3, "zero": 0.2, "golden-ticket": 0.8}
    probe = write(tmp_path / "probe", make_cell(rates, task="Mine-v1", episodes=200))
    code, shown = advise("--probe", probe, "--json")
    assert code == 0
    found = json.loads(shown.out)
    assert found["gain"]["value"] == pytest.approx(0.5)
    assert told(shown) == {"auc": "standard", "success": "standard"}
    for one in found["advice"]:
        assert one["answers"]["kind"]["sign"] == 0
        assert one["answers"]["probe"]["worlds"] == 3
    code, shown = advise("--probe", probe)
    assert "gain of the best constant noise  +0.500 [" in shown.out


def test_decisions_alone_are_a_probe(advise, tmp_path):
    records = make_cell({"base": 0.3}, task="Mine-v1", seeds=1)
    found = {"direction_p": 0.001, "drift_x": 0.0171, "drift_y": -0.0004}
    records[0].evaluations[-1].diagnostics.update(found)
    probe = write(tmp_path / "probe", records)
    code, shown = advise("--probe", probe)
    assert code == 0
    assert "opposite sides are alike         p = 0.001" in shown.out
    assert "drift of the tool                +1.71 and -0.04 cm a decision, along x" in shown.out
    assert "decisions  take standard  opposite sides are unlike (p = 0.001)" in shown.out


def test_a_test_on_left_out_tasks_is_shown(advise):
    _, shown = advise("--broken-by", "none")
    _, table = shown.out.split("Test: each world from the runs of the other tasks\n")
    header, *rows = table.splitlines()
    row = next(row for row in rows if row.startswith("kind     ") and "success" in row)
    assert header.split()[:4] == ["Rule", "By", "Decided", "Answered"]
    assert row.split()[1:6] == ["success", "6", "6", "6/6", "6/6"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), "name a world"),
        (("--task", "PushT-v1", "--broken-by", "wind"), "either with --task and --variant, or"),
        (("--task", "PushTea-v1"), "did you mean 'PushT-v1'"),
        (("--task", "PushT-v1", "--variant", "wnid:1"), "did you mean 'wind'"),
        (("--task", "PushT-v1", "--variant", "wind"), "wind"),
        (("--task", "all"), "not all"),
        (("--task", "PushT-v1", "--embodiment", "hand"), "hand"),
        (("--broken-by", "wnid"), "did you mean 'wind'"),
        (("--probe", "nowhere"), "nowhere"),
    ],
)
def test_mistakes(advise, tmp_path, monkeypatch, arguments, words):
    monkeypatch.chdir(tmp_path)
    code, shown = advise(*arguments)
    assert (code, shown.out) == (2, "")
    assert words in shown.err
    assert shown.err.count("\n") == 1


def test_a_probe_says_something_of_one_world(advise, tmp_path):
    one = write(tmp_path / "one", make_cell({"base": 0.3, "zero": 0.2}, task="Mine-v1"))
    code, shown = advise("--probe", one)
    assert code == 2
    assert "runs of base, zero and golden-ticket on the same base policy" in shown.err
    other = write(tmp_path / "other", make_cell({"base": 0.3}, task="Other-v1"))
    code, shown = advise("--probe", one, other)
    assert code == 2
    assert "the probe has runs of 2 worlds" in shown.err


def test_an_installed_package_has_no_committed_records(tmp_path, monkeypatch, command):
    monkeypatch.setattr(paths, "RECORDS", tmp_path / "nothing")
    code, shown = command("advise", "--broken-by", "wind")
    assert code == 2
    assert "name run folders: symsteer advise --runs RUNS" in shown.err
