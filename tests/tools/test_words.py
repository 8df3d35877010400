"""Words against a one-hot vector: what is said in which episode, and the tables."""

from __future__ import annotations

import json

import pytest

from symsteer.bench.steering.seeds import held_out_seeds
from symsteer.bench.sweep.suite import load_suite
from symsteer.leaderboard.text import MINUS, SPACE
from symsteer.policies.words import _data, wordings
from tools import words
from tools.pages import words as page


def test_some_sentences_are_of_several_wordings_and_name_the_things_alike():
    slots = _data()["slots"].values()
    for task in words.TASKS:
        named = []
        for held_out in (False, True):
            said = words.some(task, held_out)
            assert len(set(said)) == words.SENTENCES
            used = {[s in filled for filled in wordings(task, held_out)].index(True) for s in said}
            assert len(used) == min(words.SENTENCES, len(wordings(task, held_out)))
            named.append([{each for slot in slots for each in slot if each in s} for s in said])
        assert named[0] == named[1]


def test_the_suite_steers_what_the_tool_trains(monkeypatch, tmp_path):
    """So that both have the same files in RUNS/base."""
    given = words.parsed([str(tmp_path)])
    monkeypatch.setattr(words, "prepare_base", lambda config, execution: config)
    for run in load_suite("words").runs:
        made = words._prepared("edp-told", run.task, run.seed, given)
        assert (made.policy, made.demonstrations) == (run.policy, run.demonstrations)
        assert run.seed in given.seeds
        assert run.task in given.tasks


@pytest.mark.parametrize("tasks", [["PushCube-v1"], ["PushCube-v1"] * 2, ["PushCube-v1", "PushT"]])
def test_wrong_tasks(tasks, tmp_path, capsys):
    assert words.main([str(tmp_path), "--tasks", *tasks]) == 2
    assert capsys.readouterr().err.startswith("error: ")


def test_tables():
    def row(seed, task, one_hot, training):
        told = {"training": training, "held_out": training - 0.1, "another_task": 0.0}
        return {"seed": seed, "task": task, "one_hot": one_hot, **told}

    rows = [row(1, "A", 0.5, 0.6), row(1, "B", 0.3, 0.2), row(2, "A", 0.5, 0.8), row(2, "B", 0, 0)]
    lines = page.successes(rows).replace(SPACE, " ").splitlines()[2:]
    assert lines[0].split(" | ")[1:3] == ["0.50 [0.50, 0.50]", "0.70 [0.60, 0.80]"]
    assert lines[-1].split(" | ")[1:3] == ["0.33 [0.25, 0.40]", "0.40 [0.40, 0.40]"]
    # The means over the tasks differ by 0 and .15; t with one degree of freedom is 12.7.
    first, second, _ = page.differences(rows).replace(SPACE, " ").splitlines()[2:]
    assert f"+0.08 [{MINUS}0.88, +1.03]" in first
    assert f"{MINUS}0.10 [{MINUS}0.10, {MINUS}0.10]" in second


@pytest.mark.long
def test_the_whole_measurement(tmp_path, monkeypatch, capsys):
    heard, rollout = [], words.rollout

    def spied(env, act, seeds):
        heard.append((env.policy.options.to_json().get("instruction"), seeds))
        return rollout(env, act, seeds)

    monkeypatch.setattr(words, "rollout", spied)
    monkeypatch.setattr(words, "SENTENCES", 2)
    tasks = ["PushCube-v1", "PullCube-v1"]
    few = ["--seeds", "3", "--episodes", "4", "--demonstrations", "2", "--steps", "2"]
    assert words.main([str(tmp_path), "--tasks", *tasks, *few]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [row["task"] for row in rows] == tasks
    push = heard[:7]
    assert [sentence for sentence, _ in push] == [
        *(None, *words.some(tasks[0]), *words.some(tasks[0], held_out=True)),
        *words.some(tasks[1]),
    ]
    # Every kind of sentence has all episodes.
    for kind in (push[:1], push[1:3], push[3:5], push[5:]):
        assert sorted(seed for _, seeds in kind for seed in seeds) == held_out_seeds(4)
