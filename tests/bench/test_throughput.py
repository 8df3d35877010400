"""`symsteer throughput`: which setting executes most runs an hour, from short runs."""

from concurrent.futures import Future
from dataclasses import replace
from types import SimpleNamespace

import pytest

from symsteer.bench import throughput
from symsteer.bench.sweep.command import choices
from symsteer.bench.sweep.work import work
from symsteer.bench.throughput import Setting, fastest, measure, to_text
from symsteer.errors import UserError
from tests.bench.tiny_run import tiny_config


class ThisProcess:
    """Executes the tasks of a pool at once."""

    def __init__(self, workers, log):
        self.capacity, self.sizes = workers, []

    def submit(self, kind, configs, how):
        future = Future()
        future.set_result(work(kind, configs, how, self.patience))
        return future

    def result(self, future):
        return future.result()

    def stop(self):
        self.stopped = True


def test_each_number_is_chosen_with_the_best_of_those_before():
    """A table in which the best team depends on the processes, and these on the environments."""
    tried = []

    def rate(setting):
        tried.append(setting)
        return {64: 10, 16: 12}[setting.num_envs] + 2 * setting.workers + setting.together % 5

    found = fastest(
        {"device": ["cuda"], "num_envs": [64, 16], "workers": [1, 4], "together": [1, 20, 24]}, rate
    )
    assert tried == [
        Setting("cuda", 64, 1, 1),
        Setting("cuda", 16, 1, 1),
        Setting("cuda", 16, 4, 1),
        Setting("cuda", 16, 4, 20),
        Setting("cuda", 16, 4, 24),
    ]
    assert next(iter(found.items())) == (Setting("cuda", 16, 4, 24), 24)
    assert list(found.values()) == sorted(found.values(), reverse=True)


def test_what_is_tried_on_each_device(monkeypatch):
    monkeypatch.setattr("symsteer.bench.sweep.command._cores", lambda: 16)
    assert choices("cpu", [64])["workers"] == [16, 8]
    # Runs on a GPU share it: one process is the default there, as in a sweep.
    assert choices("cuda", [64])["workers"] == [1, 16, 8]
    assert max(choices("cuda", [64])["together"]) > max(choices("cpu", [64])["together"])


def test_the_seconds_of_a_run_follow_from_those_of_a_short_one():
    full = tiny_config("standard", env_steps=1000, options={"warmup": 50})
    full = replace(full, evaluation=replace(full.evaluation, every=300))
    short = tiny_config("standard", env_steps=100, options={"warmup": 5})
    # Evaluations end at 4 s, which began at 2 s, and at 20 s, which began at 14 s.
    clock = SimpleNamespace(
        simulate=2.0, decode=1.0, update=7.0, evaluate=5.0, diagnose=3.0, total=20.0
    )
    evaluations = [SimpleNamespace(wall_clock=4.0), SimpleNamespace(wall_clock=20.0)]
    record = SimpleNamespace(wall_clock=clock, evaluations=evaluations)
    train, evaluate = throughput._seconds(full, short, record)
    # Ten times the steps, ten times the updates, once what came before the first evaluation.
    assert train == pytest.approx(10 * 3 + 10 * 7 + 2)
    # At steps 0, 300, 600 and 900, and the last one.
    assert evaluate == pytest.approx(4 * 2 + 6)


def test_short_runs_are_measured_and_what_has_no_room_is_left_out(monkeypatch):
    monkeypatch.setattr(throughput, "UPDATES", {"cpu": 4})
    lines: list[str] = []
    config = tiny_config("standard", env_steps=240)
    wanted = {"device": ["cpu"], "num_envs": [4], "workers": [2], "together": [1, 2, 200]}
    played = []
    seconds = throughput._seconds

    def witness(full, short, record):
        played.append((short.seed, len(record.evaluations[0].episodes.seed)))
        assert record.budget.updates >= 4
        return seconds(full, short, record)

    monkeypatch.setattr(throughput, "_seconds", witness)
    found = measure(config, wanted, ThisProcess, lines.append)
    assert [(s.workers, s.together) for s in found][-1] == (2, 200)
    rates = {setting.together: rate for setting, rate in found.items()}
    assert rates[200] == 0
    assert min(rates[1], rates[2]) > 0
    assert any("left out" in line and "lower --num-envs or --together" in line for line in lines)
    # Evaluations take as long in a team, so they are played in full once.
    assert played == [(0, 3), (1, 3), (0, 1), (1, 1), (2, 1), (3, 1)]
    assert f"fastest: {max(found, key=found.get)}" in to_text(config, found)


@pytest.mark.parametrize(
    ("changes", "num_envs", "words"),
    [
        ({"agent": "zero"}, [4], "zero does not learn"),
        ({"task": "PickCub-v1"}, [4], "did you mean"),
        ({}, [4, 0], "num_envs"),
        ({}, [], "num_envs"),
    ],
)
def test_what_cannot_be_measured(changes, num_envs, words):
    config = tiny_config(**changes)
    with pytest.raises(UserError, match=words):
        measure(config, choices("cpu", num_envs), ThisProcess, print)


def test_if_nothing_can_be_measured_it_is_said(monkeypatch, capsys):
    failed = [SimpleNamespace(status="failed", reason="memory ran out")]
    monkeypatch.setattr(ThisProcess, "submit", lambda self, *task: None)
    monkeypatch.setattr(ThisProcess, "result", lambda self, future: failed)
    wanted = {"device": ["cpu"], "num_envs": [4], "workers": [1], "together": [1]}
    with pytest.raises(UserError, match="no setting can be measured"):
        measure(tiny_config("standard"), wanted, ThisProcess, print)
    assert "left out: memory ran out" in capsys.readouterr().out


def test_learners_that_cannot_be_a_team_are_tried_alone(monkeypatch):
    monkeypatch.setattr(throughput, "can_join", lambda agent: False)
    monkeypatch.setattr(
        throughput,
        "fastest",
        lambda choices, rate: {Setting("cpu", 4, 1, n): 1.0 for n in choices["together"]},
    )
    wanted = {"device": ["cpu"], "num_envs": [4], "workers": [1], "together": [1, 2]}
    found = measure(tiny_config("standard"), wanted, ThisProcess, print)
    assert [setting.together for setting in found] == [1]
