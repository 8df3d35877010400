"""Words against a one-hot vector: what is said in which episode, going on, and the tables."""

from __future__ import annotations

import json
import re

import pytest

from symsteer.bench.steering.seeds import held_out_seeds
from symsteer.bench.sweep.suite import load_suite
from symsteer.errors import UserError
from symsteer.leaderboard.records import write_record
from symsteer.leaderboard.runs import load_runs
from symsteer.leaderboard.text import MINUS, SPACE
from symsteer.policies.words import _data, wordings
from tests.leaderboard.record_factory import edited, make_cell, make_record
from tools import words
from tools.pages import words as page


def test_some_sentences_are_of_several_wordings_and_name_the_things_alike():
    fillings = {each for slot in _data()["slots"].values() for each in slot}
    for task in words.TASKS:
        named = []
        for held_out in (False, True):
            said = words.some(task, held_out)
            assert len(set(said)) == words.SENTENCES
            used = {[s in filled for filled in wordings(task, held_out)].index(True) for s in said}
            assert len(used) == min(words.SENTENCES, len(wordings(task, held_out)))
            named.append([{f for f in fillings if re.search(rf"\b{f}\b", s)} for s in said])
        assert named[0] == named[1]


def test_the_suite_steers_what_the_tool_trains(monkeypatch, tmp_path):
    """So that both have the same files in RUNS/base."""
    given = words.parsed([str(tmp_path)])
    monkeypatch.setattr(words, "prepare_base", lambda config, execution: config)
    for run in load_suite("words").runs:
        made = words._prepared(run.policy_name, run.task, run.seed, given)
        assert (made.policy, made.demonstrations) == (run.policy, run.demonstrations)
        assert run.seed in given.seeds
        assert run.task in given.tasks


@pytest.mark.parametrize(
    "wrong",
    [
        ("--tasks", "PushCube-v1"),
        ("--tasks", "PushCube-v1", "PushCube-v1"),
        ("--tasks", "PushCube-v1", "PushT"),
        ("--tasks", "PushCube-v1", "TiltedPushCube-v1"),
        ("--episodes", "100"),
        ("--seeds", "3", "3"),
    ],
)
def test_wrong_arguments(wrong, tmp_path, capsys):
    assert words.main([str(tmp_path), "--out", str(tmp_path / "words.json"), *wrong]) == 2
    assert capsys.readouterr().err.startswith("error: ")


TASKS = ("PushCube-v1", "PullCube-v1")


def row(seed, task, one_hot, training):
    """With shares that differ by sentence: the third and sixth are ahead by .06."""
    shares = {"one_hot": one_hot, "training": training, "another_task": 0.1}
    shares = {
        kind: [share - 0.03, share - 0.03, share + 0.06] * 2 for kind, share in shares.items()
    }
    held_out = [training + 0.12, training - 0.03, training - 0.24] * 2
    return {"seed": seed, "task": TASKS[task], **shares, "held_out": held_out}


ROWS = [row(1, 0, 0.5, 0.6), row(1, 1, 0.3, 0.2), row(2, 0, 0.5, 0.8), row(2, 1, 0.1, 0.1)]


def write(folder, rows):
    path = folder / "words.json"
    settings = {"tasks": TASKS, "episodes": 12, "demonstrations": 50, "steps": 1500}
    path.write_text(json.dumps({**settings, "seeds": [1, 2], "rows": rows}))
    return path


def test_it_goes_on_with_what_is_missing(tmp_path, monkeypatch, capsys):
    path, measured = write(tmp_path, ROWS[:1]), []

    def measure(seed, task, other, given):
        measured.append((seed, task, other))
        return row(seed, TASKS.index(task), 0.5, 0.5)

    monkeypatch.setattr(words, "measure", measure)
    push, pull = TASKS
    again = [str(tmp_path), "--out", str(path), "--tasks", push, pull, "--seeds", "1", "2"]
    assert words.main([*again, "--episodes", "12"]) == 0
    assert measured == [(1, pull, push), (2, push, pull), (2, pull, push)]
    assert json.loads(path.read_text())["rows"][0] == ROWS[0]
    assert words.main([*again[:-2], "3", "--episodes", "12"]) == 0
    assert json.loads(path.read_text())["seeds"] == [1, 2, 3]
    before = path.read_bytes()
    other_tasks = [*again, "--episodes", "12", "--tasks", push, pull, "PickCube-v1"]
    for other in ([*again, "--episodes", "6"], other_tasks):
        assert words.main(other) == 2
        assert "other settings" in capsys.readouterr().err
    path.write_text("{")
    assert words.main([*again, "--episodes", "12"]) == 2
    assert "cannot be read" in capsys.readouterr().err
    assert before.endswith(b"}\n")


def test_tables(tmp_path):
    rows = page.read(write(tmp_path, ROWS))
    lines = page.successes(rows).replace(SPACE, " ").splitlines()[2:]
    assert lines[0].strip("| ").split(" | ")[1:] == [
        *("0.50 [0.50, 0.50]", "0.70 [0.60, 0.80]", "0.65 [0.55, 0.75]", "0.46 [0.36, 0.56]"),
        "0.10 [0.10, 0.10]",
    ]
    assert lines[-1].split(" | ")[1:3] == ["0.35 [0.30, 0.40]", "0.43 [0.40, 0.45]"]
    # The means over the tasks differ by 0 and .15; t with one degree of freedom is 12.7 and 6.3.
    found = page.differences(rows).replace(SPACE, " ").splitlines()[2:]
    first, held_out, verb, another = (line.strip("| ").split(" | ") for line in found)
    assert first[1:] == [f"+0.08 [{MINUS}0.88, +1.03]", f"+0.08 [{MINUS}0.40, +0.55]"]
    # Any other choice of sentences gives another number.
    assert held_out[1].startswith(f"{MINUS}0.05 [{MINUS}0.05, {MINUS}0.05]")
    assert verb[1].startswith(f"{MINUS}0.30 [{MINUS}0.30, {MINUS}0.30]")
    assert another[1].startswith(f"{MINUS}0.33 [{MINUS}0.64, {MINUS}0.01]")


def records(folder):
    """Two seeds of two agents of each kind on two tasks; pairs differ, by task and by seed."""
    apart = {"PickCube-v1": (0.05, 0.15), "PlaceSphere-v1": (0.1, 0.1)}
    for k, name in enumerate(("edp-joint", "edp-told")):
        for task, begin in (("PickCube-v1", 0.1), ("PlaceSphere-v1", 0.5)):
            for seed in range(2):
                for agent, more in (("base", 0.0), ("standard", 0.2)):
                    rate = begin + 0.1 * seed + more
                    rate += k * (agent == "standard") * apart[task][seed]
                    (made,) = make_cell({agent: [0.0, rate]}, seeds=1, task=task)
                    config = {"agent": agent, "seed": seed, "task": task}
                    record = make_record(made.evaluations, **config)
                    path = folder / f"{name}-{task}-{agent}-{seed}.json"
                    write_record(edited(record, {"base_policy/name": name}), path)
    return load_runs([folder])


def test_steered(tmp_path):
    runs = records(tmp_path)
    reached, gaps = page.steered(runs).replace(SPACE, " ").split("\n\n")
    rows = [line.strip("| ").split(" | ") for line in reached.splitlines()[2:]]
    assert [row[0] for row in rows] == ["PickCube-v1"] * 2 + ["PlaceSphere-v1"] * 2
    assert [row[2:] for row in rows] == [
        ["0.15 [0.10, 0.20]", "0.35 [0.30, 0.40]"],
        ["0.15 [0.10, 0.20]", "0.45 [0.35, 0.55]"],
        ["0.55 [0.50, 0.60]", "0.75 [0.70, 0.80]"],
        ["0.55 [0.50, 0.60]", "0.85 [0.80, 0.90]"],
    ]
    base, standard = gaps.splitlines()[2:]
    assert "`base` | 0.00 [0.00, 0.00]" in base
    # By seed .075 and .125; t with one degree of freedom is 12.7 and 6.3.
    assert f"`standard` | +0.10 [{MINUS}0.22, +0.42]" in standard
    assert f"+0.10 [{MINUS}0.06, +0.26]" in standard
    for wrong in (runs[1:], [*runs, runs[0]], []):
        with pytest.raises(UserError, match="are not all there"):
            page.steered(wrong)


@pytest.mark.parametrize("rows", [ROWS[:3], ROWS[:2]], ids=["a task", "a training"])
def test_what_is_not_finished_is_no_table(rows, tmp_path):
    with pytest.raises(UserError, match="is not finished"):
        page.read(write(tmp_path, rows))


@pytest.mark.long
def test_the_whole_measurement(tmp_path, monkeypatch, capsys):
    heard, rollout = [], words.rollout

    def spied(env, act, seeds):
        heard.append((env.policy.options.to_json().get("instruction"), seeds))
        return rollout(env, act, seeds)

    monkeypatch.setattr(words, "rollout", spied)
    monkeypatch.setattr(words, "SENTENCES", 2)
    tasks, path = ["PushCube-v1", "PullCube-v1"], tmp_path / "words.json"
    few = ["--seeds", "3", "--episodes", "4", "--demonstrations", "2", "--steps", "2"]
    assert words.main([str(tmp_path), "--out", str(path), "--tasks", *tasks, *few]) == 0
    rows = json.loads(path.read_text())["rows"]
    assert [row["task"] for row in rows] == tasks
    push = heard[:8]
    assert [sentence for sentence, _ in push] == [
        *(None, None, *words.some(tasks[0]), *words.some(tasks[0], held_out=True)),
        *words.some(tasks[1]),
    ]
    # Every kind of sentence has all episodes.
    for kind in (push[:2], push[2:4], push[4:6], push[6:]):
        assert sorted(seed for _, seeds in kind for seed in seeds) == held_out_seeds(4)
