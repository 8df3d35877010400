"""One run from demonstrations to the record: its files, its errors, its repeatability."""

import contextlib
import dataclasses
import gc
import itertools
import json
import shutil

import pytest
import torch

from symsteer.agents.sac import SacAgent
from symsteer.bench.runs import evaluator, trainer
from symsteer.bench.runs.config import DemonstrationConfig, EvaluationConfig, RunConfig
from symsteer.bench.runs.folder import is_finished, state_of
from symsteer.bench.runs.run import check, evaluate
from symsteer.bench.sim import environment
from symsteer.bench.steering.seeds import held_out_seeds
from symsteer.bench.tasks import task_class
from symsteer.errors import UserError
from symsteer.leaderboard.records import read_record
from tests.bench.tiny_run import execute, tiny_config, without_clock
from tests.marks import slow_except

ONE_POLICY = DemonstrationConfig(count=3, seed=0)


def test_the_record_tells_the_whole_run(finished):
    config, folder = finished
    record = read_record(folder / "record.json")
    assert record.status == "finished"
    assert is_finished(folder)
    steps = [e.env_steps for e in record.evaluations]
    assert steps == [0, record.budget.env_steps]
    # At most one decision beyond the budget; time limits shorten chunks.
    assert 160 <= record.budget.env_steps < 160 + config.num_envs * config.policy.execute
    # No update during the warm-up of 16 decisions, then one per decision.
    assert record.budget.updates == record.budget.decisions - config.agent_options.warmup
    final = record.evaluations[-1]
    assert final.final
    assert final.episodes.seed == held_out_seeds(3)
    assert len(set(final.episodes.direction)) == 3
    low, high = task_class(config.task).feasible_return(
        config.agent_options.gamma, config.policy.execute
    )
    assert (record.feasible_q.low, record.feasible_q.high) == (low, high)
    assert final.diagnostics["equivariance_decode"] < 1e-5
    assert final.diagnostics["equivariance_actor"] < 1e-4
    assert record.base_policy.episodes == 2 * 16
    clock = record.wall_clock
    parts = clock.simulate + clock.decode + clock.update + clock.evaluate + clock.diagnose
    assert 0 < parts <= clock.total
    stored = json.loads((folder / "config.json").read_text())
    assert stored == record.config
    assert stored["agent_options"]["width"] == 16
    assert record.role == "learner"
    base = record.base_policy
    assert base.name == "edp"
    assert 0 < base.equivariance_error < 1e-5
    assert 0 < base.jump < 1
    # No path of this machine is recorded.
    assert str(folder.parent) not in (folder / "record.json").read_text()


@pytest.mark.parametrize("workers", slow_except((1, 2), 2))
def test_the_same_configuration_gives_the_same_record(workers, finished, tmp_path):
    config, folder = finished
    again = execute(config, tmp_path, sim_workers=workers)
    assert again.name == folder.name
    assert without_clock(again) == without_clock(folder)


@pytest.mark.long
def test_evaluating_more_often_does_not_change_training(finished, lend, tmp_path):
    config, folder = finished
    lend(tmp_path)
    evaluation = dataclasses.replace(config.evaluation, every=80)
    often = execute(tiny_config(evaluation=evaluation), tmp_path)
    assert len(read_record(often / "record.json").evaluations) == 3
    last = [without_clock(f)["evaluations"][-1] for f in (folder, often)]
    assert last[0]["episodes"] == last[1]["episodes"]
    assert last[0]["diagnostics"] == last[1]["diagnostics"]


def test_the_stochastic_actor_is_evaluated_if_asked_and_changes_nothing_else(
    finished, lend, tmp_path
):
    config, folder = finished
    lend(tmp_path)
    evaluation = dataclasses.replace(config.evaluation, stochastic_episodes=6)
    both = execute(tiny_config(evaluation=evaluation), tmp_path)
    *before, last = without_clock(both)["evaluations"]
    plain = without_clock(folder)["evaluations"]
    for name in ("success_stochastic", "success_at_end_stochastic"):
        share = last["diagnostics"].pop(name)
        assert share * 6 == pytest.approx(round(share * 6))
    assert [*before, last] == plain
    assert "stochastic_episodes" not in config.to_json()["evaluation"]


def test_what_the_learner_stores_of_a_time_out(finished, monkeypatch):
    """No success here, so nothing is terminal, and the last observation is the old episode's."""
    stored = []

    observe = SacAgent.observe

    def spy(self, step):
        stored.append((step.obs.clone(), step.next_obs.clone(), step.terminal.clone()))
        observe(self, step)

    monkeypatch.setattr(SacAgent, "observe", spy)
    _, folder = finished
    config = tiny_config(seed=2, policy_seed=0, demonstrations=ONE_POLICY, env_steps=240)
    execute(config, folder.parent)
    assert not any(terminal.any() for _, _, terminal in stored)
    jumps = sum(
        (next_obs != following[0]).any(dim=1).int()
        for (_, next_obs, _), following in itertools.pairwise(stored)
    )
    # 240 steps in 4 environments: each passes the limit of 50 steps once.
    assert jumps.tolist() == [1] * config.num_envs


@pytest.mark.long
def test_every_agent_runs_on_a_broken_world(every):
    """The base policy is shared with the unbroken run, not trained again."""
    for agent, folder in every.items():
        record = read_record(folder / "record.json")
        assert record.status == "finished"
        assert record.config["variant"] == "action_gain:0.5"
        assert (record.feasible_q is None) == (agent in ("base", "zero", "golden-ticket"))
        # References do not learn; the search of a golden ticket plays whole episodes.
        used = {"base": 0, "zero": 0, "golden-ticket": 200}
        assert record.budget.env_steps == used.get(agent, record.budget.env_steps)
    policies = [p for p in (folder.parent / "base").iterdir() if p.is_dir()]
    assert len(policies) == 1


def test_the_final_evaluation_plays_the_other_ways_to_act(broken):
    *before, final = read_record(broken["constrained"] / "record.json").evaluations
    assert 0 <= final.diagnostics["success_truncated"] <= 1
    assert all("success_truncated" not in e.diagnostics for e in before)
    other = read_record(broken["equivariant"] / "record.json").evaluations[-1]
    assert "success_truncated" not in other.diagnostics


def test_a_failed_run_says_so_and_is_continued(finished, monkeypatch):
    _, folder = finished
    broken = tiny_config(seed=1, policy_seed=0, demonstrations=ONE_POLICY)

    def fail(*args, **kwargs):
        raise RuntimeError("the network exploded")

    with monkeypatch.context() as patch:
        patch.setattr(trainer, "Evaluator", fail)
        with pytest.raises(RuntimeError):
            execute(broken, folder.parent)
    [failed] = folder.parent.glob("*-s1-*")
    record = read_record(failed / "record.json")
    assert record.status == state_of(failed) == "failed"
    assert "the network exploded" in record.failure
    execute(broken, folder.parent)
    assert state_of(failed) == "finished"
    assert read_record(failed / "record.json").failure is None
    shutil.rmtree(failed)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"task": "PickCub-v1"}, "PickCube-v1"),
        ({"embodiment": "hand"}, "floating"),
        ({"variant": "action_gian:0.5"}, "action_gain"),
        ({"variant": "action_gain:1.5"}, r"\[0, 1\]"),
        ({"agent": "ppo"}, "equivariant"),
        ({"variant": "obstacle:0..1"}, "built with the scene"),
        ({"variant": "action_gain:0"}, "strength 0, which changes nothing"),
        ({"variant": "wind:0+action_gain:0.5"}, "strength 0, which changes nothing"),
        ({"env_steps": 64}, "within the warm-up of 64"),
        ({"agent": "golden-ticket", "env_steps": 100}, "a search of the best constant noise needs"),
        ({"options": {"replay_capacity": 3}}, "replay_capacity is 3"),
    ],
)
def test_mistakes_are_refused_before_anything_is_built(change, words, tmp_path):
    with pytest.raises(UserError, match=words):
        execute(tiny_config(**change), tmp_path)
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("cuda", "change", "words"),
    [
        (False, {"sim": "cuda"}, "no CUDA device"),
        (False, {"device": "cuda"}, "no CUDA device"),
        (True, {"workers": 0}, "--sim-workers is"),
        (True, {"workers": 2, "sim": "cuda"}, "--sim-workers needs"),
    ],
)
def test_what_this_machine_cannot_do_is_refused(cuda, change, words, tmp_path, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: cuda)
    workers = change.pop("workers", 1)
    with pytest.raises(UserError, match=words):
        execute(tiny_config(**change), tmp_path, sim_workers=workers)


ROOMY = {"num_envs": 500, "env_steps": 10**6}


@pytest.mark.parametrize(
    ("change", "workers", "words"),
    [
        (ROOMY, 1, "1005 are needed while those of 500 .* replaced; use --sim-workers 2"),
        (ROOMY | {"num_envs": 3000}, 4, "but 1500 are needed .* use --sim-workers 7"),
        (
            {"evaluation": EvaluationConfig(episodes=3000)},
            1,
            "; make fewer .*--evaluation.episodes",
        ),
        (ROOMY, 2, None),
        (ROOMY | {"agent": "base"}, 1, None),
    ],
)
def test_more_environments_than_processes_can_hold(change, workers, words, tmp_path):
    config = tiny_config(**change)
    if words is None:
        return check(config, workers)
    with pytest.raises(UserError, match=words):
        execute(config, tmp_path, sim_workers=workers)
    assert not any(tmp_path.iterdir())


@pytest.mark.long
def test_a_run_needs_just_as_many_scenes_as_is_said(lend, tmp_path, monkeypatch):
    lend(tmp_path)
    monkeypatch.setattr(evaluator, "MAX_SCENES", 26)
    with pytest.raises(UserError, match="at most 26 PhysX scenes, but 27 are"):
        execute(tiny_config(num_envs=11), tmp_path)
    gc.collect()
    there = environment._count(environment._LIVE_SCENES)
    monkeypatch.setattr(evaluator, "MAX_SCENES", 27)
    for spare in (0, -1):
        monkeypatch.setattr(environment, "MAX_SCENES", there + 27 + spare)
        with contextlib.nullcontext() if spare == 0 else pytest.raises(UserError, match="exist"):
            execute(tiny_config(num_envs=11, seed=-spare), tmp_path)


def test_an_unwritable_folder_is_refused(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UserError, match="writable"):
        execute(tiny_config(), tmp_path / "file")


@pytest.mark.long
def test_the_settings_of_a_given_base_policy_are_recorded(finished, tmp_path):
    """The run has the settings and demonstrations of the file, not the defaults."""
    config, folder = finished
    file = folder / "policy.safetensors"
    plain = tiny_config(
        agent="zero",
        policy=RunConfig().policy,
        demonstrations=DemonstrationConfig(),
    )
    found = read_record(execute(plain, tmp_path, base_policy=file) / "record.json")
    said = found.config
    assert said["policy"] == config.to_json()["policy"]
    assert said["demonstrations"]["count"] == 3
    known = read_record(folder / "record.json").base_policy
    assert found.base_policy == known
    # So is its seed. Steerability is measured on the number of states of this run.
    evaluation = dataclasses.replace(plain.evaluation, steerability_states=3)
    more = dataclasses.replace(
        tiny_config(agent="zero", seed=6, evaluation=evaluation), policy=RunConfig().policy
    )
    found = read_record(execute(more, tmp_path, base_policy=file) / "record.json")
    assert (found.seeds["run"], found.seeds["policy"], found.seeds["demonstrations"]) == (6, 0, 0)
    assert (known.episodes, found.base_policy.episodes) == (32, 48)


def test_a_base_policy_of_another_world_is_refused(finished, tmp_path):
    config, folder = finished
    panda = tiny_config(embodiment="panda")
    with pytest.raises(UserError, match="trained for floating, and this run's embodiment is panda"):
        execute(panda, tmp_path, base_policy=folder)
    other = tiny_config(policy=dataclasses.replace(config.policy, steps=21))
    with pytest.raises(UserError, match=r"trained with policy\.steps 20, and this run asks for 21"):
        execute(other, tmp_path, base_policy=folder)
    for change in ({"policy_seed": 4}, {"demonstrations": DemonstrationConfig(count=3, seed=9)}):
        with pytest.raises(UserError, match=rf"trained with {min(change)}\S* 0, and this run"):
            execute(tiny_config(**change), tmp_path, base_policy=folder)
    with pytest.raises(UserError, match="leave one of them out"):
        execute(config, tmp_path, demos=folder, base_policy=folder)
    assert not any(tmp_path.iterdir())


def test_an_evaluation_in_the_runs_own_world_is_compared_however_it_is_spelled(broken):
    folder = broken["zero"]
    spelled = evaluate(folder, "action_gain:0.50")
    assert (spelled.variant, spelled.recorded) == ("action_gain:0.5", True)
    with pytest.raises(UserError, match="there is no variant ''"):
        evaluate(folder, "")
