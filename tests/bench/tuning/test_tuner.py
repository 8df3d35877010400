"""The search, on runs whose success is a known function of the options; and one real one."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil

import numpy as np
import pytest

from symsteer.agents.equivariant import EquivariantAgent
from symsteer.agents.presets import preset_options
from symsteer.bench.runs.config import build_config
from symsteer.bench.runs.folder import RECORD, run_id
from symsteer.bench.sweep.schedule import Outcome
from symsteer.bench.sweep.survey import look
from symsteer.bench.tuning import command
from symsteer.bench.tuning.command import Tuner, preview
from symsteer.bench.tuning.plan import read_plan
from symsteer.bench.tuning.search import Search, open_storage, storage_path
from symsteer.bench.tuning.trials import (
    Score,
    TrialResult,
    best_single,
    choose,
    mean_auc,
    mean_ranks,
    score_of,
    to_text,
)
from symsteer.cli import main
from symsteer.errors import UserError
from symsteer.leaderboard.records import write_record
from tests.bench.tuning.tiny_plan import BEST, TEXT, KnownRuns, write_plan
from tests.leaderboard.record_factory import make_evaluation, make_record


@pytest.fixture
def play(tmp_path, monkeypatch):
    """Plays a plan in ``out`` with known runs; returns trials, choices and the runs."""

    def run(out="runs", text=TEXT, **kwargs):
        runs = KnownRuns(**kwargs)
        monkeypatch.setattr(command, "run_plan", runs)
        tuner = Tuner(read_plan(write_plan(tmp_path, text)), tmp_path / out)
        return *tuner.play(), runs

    return run


def scores_of(*areas):
    return [Score(f"task-{i % 2} cell", area, area, 60.0) for i, area in enumerate(areas)]


def test_agents_try_the_settings_of_the_others(play):
    results, _, _ = play()
    best = {a: choose([t for t in results if t.agent == a]).options for a in BEST}
    further, chosen, _ = play("more", TEXT.replace("trials = 12", "trials = 12\nexchange = 2"))
    assert further[:12] == results[:12]
    for agent, other in (("standard", "equivariant"), ("equivariant", "standard")):
        own = [t for t in further if t.agent == agent]
        assert [t.number for t in own] == list(range(14))
        shared = {k: v for k, v in best[other].items() if k in best[agent]}
        assert own[12].options == {**best[agent], **shared}
        assert own[13].options not in [t.options for t in own[:13]]
    # Once: the same call finds nothing left.
    again, same, runs = play("more", TEXT.replace("trials = 12", "trials = 12\nexchange = 2"))
    assert (again, same) == (further, chosen)
    assert runs.played == []


def test_further_settings_come_before_the_exchange(play, tmp_path):
    text = TEXT.replace("trials = 12", "trials = 12\nexchange = 1")
    results, _, _ = play(text=text + "\n[[further]]\nlr = 0.011\n")
    plan = read_plan(tmp_path / "tiny.toml")
    for agent in BEST:
        own = [t for t in results if t.agent == agent]
        assert len(own) == 14
        assert own[12].options == {**plan.start(agent), "lr": 0.011}
        assert own[13].options["lr"] != 0.011


def test_exchanged_settings_are_tried_once(play, tmp_path):
    plan = read_plan(write_plan(tmp_path, TEXT.replace("trials = 12", "trials = 12\nexchange = 2")))
    play()
    search = Search(plan, "standard", open_storage(storage_path(tmp_path / "runs", plan.name)))
    known = search.ended[0].params
    others = [{**known, "lr": lr} for lr in (0.011, 0.012, 0.013)]
    search.enqueue([known, others[0], others[0]], 12, 2)
    # A later call, with what was chosen meanwhile, changes nothing.
    search.enqueue(others, 12, 2)
    tried = [t.params for t in search.batch(14)]
    assert tried[0] == others[0]
    assert tried[1] not in [known, *others]


def test_a_score_says_whether_q_stayed_finite(tmp_path):
    config = build_config({"env_steps": 20_000}, "test")
    folder = tmp_path / run_id(config, {})
    for q_mean, finite in ((-3.0, True), (math.nan, False)):
        curve = [
            make_evaluation([1, 0], 0, final=False),
            make_evaluation([0, 0], 20_000, q_mean=q_mean),
        ]
        folder.mkdir(exist_ok=True)
        (folder / RECORD).unlink(missing_ok=True)
        write_record(make_record(curve, env_steps=20_000), folder / RECORD)
        assert score_of(config, tmp_path).finite == finite
        # The line of a sweep says it, too: success 0 may have this reason.
        assert look(folder).success == f"success   0% of 2{'' if finite else ', Q not finite'}"


def trial(number, *areas, state="complete"):
    scores = scores_of(*areas)
    return TrialResult("standard", number, state, {"lr": number}, scores)


def test_ranks_are_means_over_cells_and_ties_share_them():
    assert mean_ranks([scores_of(0.5, 0.9), scores_of(0.7, 0.9), scores_of(0.1, 0.2)]) == [
        pytest.approx(x) for x in ((2 + 1.5) / 2, (1 + 1.5) / 2, 3.0)
    ]


def test_the_best_mean_rank_is_chosen_not_the_best_mean():
    """One cell in which areas vary much does not decide alone."""
    trials = [trial(0, 0.1, 0.50, 0.50), trial(1, 0.9, 0.48, 0.48), trial(2, 0.2, 0.51, 0.51)]
    found = choose(trials)
    assert np.argmax([t.auc for t in trials]) == 1
    assert (found.trial, found.rank) == (2, pytest.approx(4 / 3))
    assert found.start_rank == pytest.approx((3 + 2 + 2) / 3)


def test_every_task_has_a_best_trial_of_its_own():
    trials = [
        trial(0, 0.5, 0.9, 0.5, 0.9),
        trial(1, 0.7, 0.1, 0.4, 0.2),
        trial(2, 0.6, 0.8, 0.8, 0.8),
    ]
    assert choose(trials).by_task == {"task-0": 2, "task-1": 0}


def test_the_best_single_option_may_be_none():
    found = dataclasses.replace(
        choose([trial(0, 0.5, 0.5)]),
        singles={"lr": scores_of(0.6, 0.4), "tau": scores_of(0.7, 0.6)},
    )
    assert best_single(found, scores_of(0.5, 0.5)) == "tau"
    assert best_single(found, scores_of(0.8, 0.8)) is None


def test_trials_that_were_given_up_are_not_chosen():
    found = choose([trial(0, 0.5, 0.5), trial(1, 0.9, state="pruned"), trial(2, 0.4, 0.4)])
    assert found.trial == 0
    assert choose([trial(0, 0.5, state="failed"), trial(1, 0.4, 0.4)]) is None


def test_every_agent_has_the_same_number_of_trials_and_begins_with_its_defaults(play):
    trials, chosen, _ = play()
    for agent in ("standard", "equivariant"):
        own = [t for t in trials if t.agent == agent]
        assert [t.number for t in own] == list(range(12))
        assert own[0].options["lr"] == 6e-4
        assert own[0].state == "complete"
    assert [choice.agent for choice in chosen] == ["standard", "equivariant"]


def test_the_search_comes_closer_to_the_known_optimum_than_the_defaults(play):
    _, chosen, _ = play()
    for choice in chosen:
        best = BEST[choice.agent]
        assert abs(math.log(choice.options["lr"] / best)) < abs(math.log(6e-4 / best))
        fresh, default = ([s.auc for s in choice.fresh[x]] for x in ("chosen", "start"))
        assert len(fresh) == len(default) == 2
        assert min(fresh) > max(default)


def test_bad_trials_are_given_up_after_the_probe(play):
    trials, _, runs = play()
    states = {t.state for t in trials}
    assert states == {"complete", "pruned"}
    for t in trials:
        assert len(t.scores) == (1 if t.state == "pruned" else 2)
    # Chosen settings and defaults on two fresh cells each, for two agents.
    assert len(runs.played) == sum(len(t.scores) for t in trials) + 8


def test_options_are_tried_by_themselves_where_the_plan_says_so(play):
    """Success depends on lr alone, so lr alone is as good as the choice."""
    trials, chosen, _ = play(
        text=TEXT.replace("trials = 12", 'trials = 12\nsingles = ["standard"]')
    )
    standard, equivariant = chosen
    options = {"lr", "batch_size"} if standard.options["batch_size"] == 32 else {"lr"}
    assert set(standard.singles) == options
    assert mean_auc(standard.singles["lr"]) > mean_auc(trials[0].scores)
    assert equivariant.singles == {}
    areas = {setting: [s.auc for s in scores] for setting, scores in standard.fresh.items()}
    assert areas["one_option"] == areas["chosen"] > areas["start"]
    assert set(equivariant.fresh) == {"start", "chosen", "by_task"}


@pytest.mark.long
def test_a_search_that_was_killed_continues_with_the_same_trials(play):
    whole, chosen, runs = play("undisturbed")
    for stop in (1, 8, 25, len(runs.played) - 1):
        out = f"stopped-{stop}"
        with pytest.raises(KeyboardInterrupt):
            play(out, stop_after=stop)
        again, same, rest = play(out)
        assert again == whole
        assert same == chosen
        assert len(rest.played) == len(runs.played) - stop


def test_the_choice_is_written_before_it_is_compared(play, tmp_path):
    _, chosen, runs = play()
    with pytest.raises(KeyboardInterrupt):
        play("stopped", stop_after=len(runs.played) - 1)
    folders = [tmp_path / out / "tuning" for out in ("runs", "stopped")]
    whole, stopped = (json.loads((folder / "tiny.json").read_text()) for folder in folders)
    assert stopped["trials"] == whole["trials"]
    assert [choice["trial"] for choice in stopped["chosen"]] == [choice.trial for choice in chosen]
    assert all(choice["fresh"] == {} for choice in stopped["chosen"])
    presets = [(folder / "tiny-preset.toml").read_text() for folder in folders]
    assert presets[0] == presets[1]


def test_more_trials_can_be_added_later(play):
    first, _, _ = play()
    more, _, runs = play(text=TEXT.replace("trials = 12", "trials = 14"))
    assert [t for t in more if t.number < 12] == first
    assert max(t.number for t in more) == 13
    assert 4 <= len(runs.played) <= 16


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("tiny-scores.json", '{"run": {"auc": "high"}}'),
        ("tiny-scores.json", "[" * 100_000),
        ("tiny.journal", "{}\n"),
        ("tiny.journal", "nothing\n[]\n"),
    ],
)
def test_a_damaged_file_of_a_search_is_named(play, tmp_path, name, text):
    play()
    (tmp_path / "runs" / "tuning" / name).write_text(text)
    with pytest.raises(UserError, match=rf"{name} is not a .*; (restore it, or )?delete it"):
        play()


def test_trials_of_another_plan_are_refused(play):
    play()
    with pytest.raises(
        UserError, match=r"tiny.toml is not as it was .*only description, trials, further"
    ):
        play(text=TEXT.replace("high = 1e-1", "high = 1e-2"))


def test_options_with_which_runs_fail_cost_their_trial(play, capsys):
    trials, chosen, _ = play(failing=0.02)
    failed = [t for t in trials if t.state == "failed"]
    assert failed
    assert all(t.options["lr"] > 0.02 and not t.scores for t in failed)
    assert len(trials) == 24
    assert all(choice.options["lr"] <= 0.02 for choice in chosen)
    assert "Q is not finite" in capsys.readouterr().err


def test_a_run_of_another_process_costs_no_trial(play, tmp_path, monkeypatch):
    def busy(plan, workers, ray, together):
        return [Outcome(run, "elsewhere", "busy") for run in plan.runs]

    monkeypatch.setattr(command, "run_plan", busy)
    tuner = Tuner(read_plan(write_plan(tmp_path)), tmp_path / "runs")
    with pytest.raises(UserError, match=r"another process works on PickCube"):
        tuner.play()
    assert tuner.results == []
    trials, _, _ = play()
    assert len(trials) == 24
    assert trials[0].state == "complete"


def test_a_search_goes_on_from_its_journal_and_scores_alone(play, tmp_path):
    trials, chosen, _ = play()
    with pytest.raises(KeyboardInterrupt):
        play("moved", stop_after=31)
    for folder in (tmp_path / "moved").iterdir():
        if folder.name != "tuning":
            shutil.rmtree(folder)
    kept = json.loads((tmp_path / "moved" / "tuning" / "tiny-scores.json").read_text())
    assert 20 < len(kept) <= 31
    moved, same, runs = play("moved")
    assert (moved, same) == (trials, chosen)
    assert not set(runs.played) & set(kept)
    # All runs are known: nothing is left to do.
    *_, runs = play("moved")
    assert runs.played == []


@pytest.mark.parametrize("text", ["{", "[1]", '{"a": {"auc": 1}}'])
def test_a_file_that_has_no_scores_is_refused(play, tmp_path, text):
    path = tmp_path / "runs" / "tuning" / "tiny-scores.json"
    path.parent.mkdir(parents=True)
    path.write_text(text)
    with pytest.raises(UserError, match=r"tiny-scores.json is not a file of scores"):
        play()


def test_what_is_written_can_be_read_again(play, tmp_path):
    trials, chosen, _ = play()
    folder = tmp_path / "runs" / "tuning"
    data = json.loads((folder / "tiny.json").read_text())
    assert [t["options"] for t in data["trials"]] == [dict(t.options) for t in trials]
    assert data["chosen"][1]["fresh"]["chosen"][0]["auc"] == chosen[1].fresh["chosen"][0].auc
    path = str(folder / "tiny-preset.toml")
    found = preset_options(path, "equivariant", EquivariantAgent.Options)
    assert found == {k: pytest.approx(v, rel=1e-3) for k, v in chosen[1].options.items()}


def test_the_table_has_a_row_for_each_agent(play):
    trials, chosen, _ = play()
    header, *rows = to_text(trials, chosen).splitlines()
    assert header.split()[:4] == ["agent", "trials", "pruned", "failed"]
    assert [row.split()[:2] for row in rows] == [["standard", "12"], ["equivariant", "12"]]


def test_the_preview_counts_the_runs(tmp_path):
    text = preview(read_plan(write_plan(tmp_path)))
    assert "standard: 12 trials of 2 options: lr, batch_size" in text
    assert "at most 60 runs" in text


REAL = """
description = "one agent, one cell"
agents = ["standard"]
trials = 2
batch = 2
probe = 1
[grid]
seed = [1]
[confirm]
seed = [1]
task = ["PushCube-v1"]
[run]
task = "PushCube-v1"
env_steps = 160
num_envs = 4
demonstrations.count = 3
agent = { width = 16, warmup = 16, gamma = 0.5 }
policy = { channels = 8, width = 16, depth = 1, steps = 20, batch_size = 32 }
[run.evaluation]
every = 80
episodes = 2
final_episodes = 2
diagnostic_episodes = 2
final_diagnostic_episodes = 2
steerability_states = 2
[space]
lr = { low = 1e-4, high = 1e-2, log = true }
"""


@pytest.mark.slow
def test_the_command_tunes_with_real_runs(tmp_path, monkeypatch, capsys):
    path, out = write_plan(tmp_path, REAL), str(tmp_path / "runs")
    arguments = ["symsteer", "tune", path, "--out", out, "--workers", "1"]
    monkeypatch.setattr("sys.argv", arguments)
    assert main() == 0
    first = capsys.readouterr().out
    assert "trial     standard 2 of 2: complete" in first
    assert "standard-preset" not in first
    assert str(tmp_path / "runs" / "tuning" / "tiny-preset.toml") in first
    # Again: all is done, and the same table is printed.
    assert main() == 0
    again = capsys.readouterr().out
    assert again.splitlines()[-7:] == first.splitlines()[-7:]
