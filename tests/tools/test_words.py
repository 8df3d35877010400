"""Words against a one-hot vector: what is said in which episode, going on, and the tables."""

from __future__ import annotations

import json
import re

import pytest

from symsteer.bench.steering.seeds import held_out_seeds
from symsteer.bench.sweep.suite import load_suite
from symsteer.errors import UserError
from symsteer.leaderboard.text import MINUS, SPACE
from symsteer.policies.words import _data, wordings
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
        ("--episodes", "100"),
    ],
)
def test_wrong_arguments(wrong, tmp_path, capsys):
    assert words.main([str(tmp_path), "--out", str(tmp_path / "words.json"), *wrong]) == 2
    assert capsys.readouterr().err.startswith("error: ")


def row(seed, task, one_hot, training):
    told = {"training": [training] * 6, "another_task": [0.0] * 6}
    told["held_out"] = [training, training, training - 0.3] * 2
    return {"seed": seed, "task": task, "one_hot": [one_hot] * 6, **told}


ROWS = [row(1, "A", 0.5, 0.6), row(1, "B", 0.3, 0.2), row(2, "A", 0.5, 0.8), row(2, "B", 0, 0)]


def write(folder, rows):
    path = folder / "words.json"
    path.write_text(json.dumps({"episodes": 12, "demonstrations": 50, "steps": 1500, "rows": rows}))
    return path


def test_it_goes_on_with_what_is_missing(tmp_path, monkeypatch, capsys):
    path, measured = write(tmp_path, ROWS[:1]), []

    def measure(seed, task, other, given):
        measured.append((seed, task, other))
        return row(seed, task, 0.5, 0.5)

    monkeypatch.setattr(words, "measure", measure)
    again = [str(tmp_path), "--out", str(path), "--tasks", "A", "B", "--seeds", "1", "2"]
    assert words.main([*again, "--episodes", "12"]) == 0
    assert measured == [(1, "B", "A"), (2, "A", "B"), (2, "B", "A")]
    assert json.loads(path.read_text())["rows"][0] == ROWS[0]
    before = path.read_bytes()
    assert words.main([*again, "--episodes", "6"]) == 2
    assert "other settings" in capsys.readouterr().err
    path.write_text("{")
    assert words.main([*again, "--episodes", "12"]) == 2
    assert "cannot be read" in capsys.readouterr().err
    assert before.endswith(b"}\n")


def test_tables(tmp_path):
    rows = page.read(write(tmp_path, ROWS))
    lines = page.successes(rows).replace(SPACE, " ").splitlines()[2:]
    assert lines[0].split(" | ")[1:3] == ["0.50 [0.50, 0.50]", "0.70 [0.60, 0.80]"]
    assert lines[-1].split(" | ")[1:3] == ["0.33 [0.25, 0.40]", "0.40 [0.40, 0.40]"]
    # The means over the tasks differ by 0 and .15; t with one degree of freedom is 12.7 and 6.3.
    first, held_out, verb, _ = page.differences(rows).replace(SPACE, " ").splitlines()[2:]
    assert f"+0.08 [{MINUS}0.88, +1.03] | +0.08 [{MINUS}0.40, +0.55]" in first
    assert f"{MINUS}0.10 [{MINUS}0.10, {MINUS}0.10]" in held_out
    assert f"{MINUS}0.30 [{MINUS}0.30, {MINUS}0.30]" in verb


@pytest.mark.parametrize("rows", [ROWS[:3], ROWS[:2]], ids=["a task", "one training"])
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
