"""The search, on runs whose success is a known function of the options; and one real one."""

# ruff: noqa: E402
from __future__ import annotations

import dataclasses
import json
import math
import shutil

import pytest

from tests.marks import need

need("tune")

from symsteer.agents.equivariant import EquivariantAgent
from symsteer.agents.presets import preset_options
from symsteer.bench.runs.config import build_config
from symsteer.bench.runs.folder import RECORD, run_id
from symsteer.bench.sweep.schedule import EndedRun
from symsteer.bench.sweep.survey import look
from symsteer.bench.tuning import command as tuning
from symsteer.bench.tuning.command import Tuner
from symsteer.bench.tuning.plan import read_plan
from symsteer.bench.tuning.search import Search, open_storage
from symsteer.bench.tuning.trials import (
    Score,
    TrialResult,
    best_single,
    choose,
    from_json,
    mean_auc,
    mean_ranks,
    score_of,
    to_text,
)
from symsteer.errors import UserError
from symsteer.leaderboard.paths import RESULTS
from symsteer.leaderboard.records import write_record
from tests.bench.tuning.conftest import play_plan
from tests.bench.tuning.tiny_plan import BEST, TEXT, KnownRuns, write_plan
from tests.leaderboard.record_factory import make_evaluation, make_record


def scores_of(*areas):
    return [Score(f"task-{i % 2} cell", area, area, 60.0) for i, area in enumerate(areas)]


def trial(number, *areas, state="complete"):
    return TrialResult("standard", number, state, {"lr": number}, scores_of(*areas))


def test_agents_try_further_settings_and_then_those_of_the_others(whole, again):
    """All that may change after the first trial is added to a search that had ended."""
    more = TEXT.replace("trials = 12", "trials = 12\nexchange = 2") + "\n[[further]]\nlr = 0.011\n"
    played = again(text=more)
    best = {a: choose(played.of(a)[:13]).options for a in BEST}
    for agent, other in (("standard", "equivariant"), ("equivariant", "standard")):
        trials = played.of(agent)
        assert trials[:12] == whole.of(agent)
        assert [t.number for t in trials] == list(range(15))
        assert trials[12].options == {**trials[0].options, "lr": 0.011}
        shared = {k: v for k, v in best[other].items() if k in best[agent]}
        assert trials[13].options == {**best[agent], **shared}
        assert trials[14].options not in [t.options for t in trials[:14]]
    # Once: the same call finds nothing left.
    same = again(text=more)
    assert same[:2] == played[:2]
    assert same.runs.played == []


def test_exchanged_settings_are_tried_once(whole, again, tmp_path):
    plan = read_plan(write_plan(tmp_path, TEXT.replace("trials = 12", "trials = 12\nexchange = 2")))
    search = Search(plan, "standard", open_storage(tmp_path / "runs/tuning/tiny.journal"))
    known = search.results[0].options
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


def test_the_best_mean_rank_is_chosen():
    """Not the best mean: one cell in which areas vary much does not decide alone."""
    assert mean_ranks([scores_of(0.5, 0.9), scores_of(0.7, 0.9), scores_of(0.1, 0.2)]) == [
        pytest.approx(x) for x in ((2 + 1.5) / 2, (1 + 1.5) / 2, 3.0)
    ]
    choice = choose(
        [trial(0, 0.1, 0.50, 0.50), trial(1, 0.9, 0.48, 0.48), trial(2, 0.2, 0.51, 0.51)]
    )
    assert (choice.trial, choice.rank) == (2, pytest.approx(4 / 3))
    assert choice.start_rank == pytest.approx((3 + 2 + 2) / 3)
    # Every task has a best trial of its own, and trials that were given up are not chosen.
    areas = ((0.5, 0.9, 0.5, 0.9), (0.7, 0.1, 0.4, 0.2), (0.6, 0.8, 0.8, 0.8))
    assert choose([trial(i, *x) for i, x in enumerate(areas)]).by_task == {"task-0": 2, "task-1": 0}
    pruned = trial(1, 0.9, state="pruned")
    assert choose([trial(0, 0.5, 0.5), pruned, trial(2, 0.4, 0.4)]).trial == 0
    assert choose([trial(0, 0.5, state="failed"), trial(1, 0.4, 0.4)]) is None
    # The best single option may be none.
    singles = {"lr": scores_of(0.6, 0.4), "tau": scores_of(0.7, 0.6)}
    choice = dataclasses.replace(choose([trial(0, 0.5, 0.5)]), singles=singles)
    assert best_single(choice, scores_of(0.5, 0.5)) == "tau"
    assert best_single(choice, scores_of(0.8, 0.8)) is None


def test_agents_have_the_same_number_of_trials_and_bad_ones_are_given_up(whole):
    for agent in BEST:
        trials = whole.of(agent)
        assert [t.number for t in trials] == list(range(12))
        assert (trials[0].options["lr"], trials[0].state) == (6e-4, "complete")
    assert [choice.agent for choice in whole.chosen] == ["standard", "equivariant"]
    assert {t.state for t in whole.trials} == {"complete", "pruned"}
    for t in whole.trials:
        assert len(t.scores) == (1 if t.state == "pruned" else 2)
    # Chosen settings and defaults on two fresh cells each, for two agents.
    assert len(whole.runs.played) == sum(len(t.scores) for t in whole.trials) + 8


def test_the_search_comes_closer_to_the_known_optimum_than_the_defaults(whole):
    for choice in whole.chosen:
        best = BEST[choice.agent]
        assert abs(math.log(choice.options["lr"] / best)) < abs(math.log(6e-4 / best))
        fresh, default = ([s.auc for s in choice.fresh[x]] for x in ("chosen", "start"))
        assert len(fresh) == len(default) == 2
        assert min(fresh) > max(default)


def test_options_are_tried_by_themselves_where_the_plan_says_so(again):
    """Success depends on lr alone, so lr alone is as good as the choice."""
    played = again(text=TEXT.replace("trials = 12", 'trials = 12\nsingles = ["standard"]'))
    standard, equivariant = played.chosen
    options = {"lr", "batch_size"} if standard.options["batch_size"] == 32 else {"lr"}
    assert set(standard.singles) == options
    assert mean_auc(standard.singles["lr"]) > mean_auc(played.trials[0].scores)
    assert equivariant.singles == {}
    areas = {setting: [s.auc for s in scores] for setting, scores in standard.fresh.items()}
    assert areas["one_option"] == areas["chosen"] > areas["start"]
    assert set(equivariant.fresh) == {"start", "chosen", "by_task"}


@pytest.mark.parametrize("stop", [1, -1])
def test_a_search_that_was_killed_continues_with_the_same_trials(stop, whole, tmp_path):
    stop %= len(whole.runs.played)
    with pytest.raises(KeyboardInterrupt):
        play_plan(tmp_path, stop_after=stop)
    if stop > 25:
        # The choice is written before it is compared.
        kept, stopped = (
            json.loads((folder / "tiny.json").read_text())
            for folder in (whole.folder, tmp_path / "runs" / "tuning")
        )
        assert stopped["trials"] == kept["trials"]
        assert [c["trial"] for c in stopped["chosen"]] == [c.trial for c in whole.chosen]
        assert all(choice["fresh"] == {} for choice in stopped["chosen"])
    played = play_plan(tmp_path)
    assert played[:2] == whole[:2]
    assert len(played.runs.played) == len(whole.runs.played) - stop


def test_a_search_goes_on_from_its_journal_and_scores_alone(whole, tmp_path):
    with pytest.raises(KeyboardInterrupt):
        play_plan(tmp_path, stop_after=31)
    for folder in (tmp_path / "runs").iterdir():
        if folder.name != "tuning":
            shutil.rmtree(folder)
    kept = json.loads((tmp_path / "runs" / "tuning" / "tiny-scores.json").read_text())
    assert 20 < len(kept) <= 31
    moved = play_plan(tmp_path)
    assert moved[:2] == whole[:2]
    assert not set(moved.runs.played) & set(kept)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("tiny-scores.json", '{"run": {"auc": "high"}}'),
        ("tiny-scores.json", "[" * 100_000),
        ("tiny.journal", "{}\n"),
        ("tiny.journal", "nothing\n[]\n"),
    ],
)
def test_a_damaged_file_of_a_search_is_named(tmp_path, name, text):
    path = tmp_path / "runs" / "tuning" / name
    path.parent.mkdir(parents=True)
    path.write_text(text)
    with pytest.raises(UserError, match=rf"{name} is not a .*; (restore it, or )?delete it"):
        play_plan(tmp_path)


def test_trials_of_another_plan_are_refused(again):
    with pytest.raises(
        UserError, match=r"tiny.toml is not as it was .*only description, trials, further"
    ):
        again(text=TEXT.replace("high = 1e-1", "high = 1e-2"))


def test_options_with_which_runs_fail_cost_their_trial(tmp_path, capsys):
    played = play_plan(tmp_path, failing=0.02)
    failed = [t for t in played.trials if t.state == "failed"]
    assert failed
    assert all(t.options["lr"] > 0.02 and not t.scores for t in failed)
    assert len(played.trials) == 24
    assert all(choice.options["lr"] <= 0.02 for choice in played.chosen)
    assert "Q is not finite" in capsys.readouterr().err


def test_a_run_of_another_process_costs_no_trial(tmp_path, monkeypatch):
    def busy(plan, workforce):
        return [EndedRun(run, "elsewhere", "busy") for run in plan.runs]

    monkeypatch.setattr(tuning, "run_plan", busy)
    tuner = Tuner(read_plan(write_plan(tmp_path)), tmp_path / "runs")
    with pytest.raises(UserError, match=r"another process works on PickCube"):
        tuner.play()
    assert tuner.results == []
    assert [trial.number for trial in tuner.searches["standard"].batch(12)] == [0, 1, 2]


def test_what_is_written_can_be_read_again(whole):
    data = json.loads((whole.folder / "tiny.json").read_text())
    assert [t["options"] for t in data["trials"]] == [dict(t.options) for t in whole.trials]
    choice = whole.chosen[1]
    assert data["chosen"][1]["fresh"]["chosen"][0]["auc"] == choice.fresh["chosen"][0].auc
    path = str(whole.folder / "tiny-preset.toml")
    preset = preset_options(path, "equivariant", EquivariantAgent.Options)
    assert preset == {k: pytest.approx(v, rel=1e-3) for k, v in choice.options.items()}
    header, *lines = to_text(whole.trials, whole.chosen).splitlines()
    assert header.split()[:4] == ["agent", "trials", "pruned", "failed"]
    assert [line.split()[:2] for line in lines] == [["standard", "12"], ["equivariant", "12"]]


def test_a_committed_search_can_be_gone_on_with(tmp_path):
    """That of the plan zoo has an agent that is no more."""
    name = "core"
    for path in RESULTS.glob(f"tuning/{name}*"):
        (tmp_path / "tuning").mkdir(exist_ok=True)
        shutil.copy(path, tmp_path / "tuning")
    tuner = Tuner(read_plan(name), tmp_path)
    trials, chosen = from_json(json.loads((tmp_path / "tuning" / f"{name}.json").read_text()))
    assert [dataclasses.asdict(t) for t in tuner.results] == [dataclasses.asdict(t) for t in trials]
    assert [tuner.searches[c.agent].best.trial for c in chosen] == [c.trial for c in chosen]


def test_the_command_says_what_it_does_and_where_the_results_are(tmp_path, monkeypatch, command):
    monkeypatch.setattr(tuning, "run_plan", KnownRuns())
    words = ("tune", write_plan(tmp_path), "--runs", tmp_path / "runs")
    code, shown = command(*words, "--dry-run")
    assert code == 0
    assert "standard: 12 trials of 2 options: lr, batch_size" in shown.out
    assert "at most 60 runs" in shown.out
    code, first = command(*words)
    assert code == 0
    assert "trial     standard 12 of 12: " in first.out
    assert str(tmp_path / "runs" / "tuning" / "tiny-preset.toml") in first.out
    # Again: all is done, and the same table is printed.
    assert command(*words)[1].out.splitlines()[-8:] == first.out.splitlines()[-8:]
