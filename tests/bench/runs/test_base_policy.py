"""Base policies of runs: made once, found again, steered; of several tasks, and of strangers."""

import dataclasses
from concurrent.futures import ThreadPoolExecutor

import pytest

from symsteer.bench.demos import collect
from symsteer.bench.runs import base_policy
from symsteer.bench.runs.base_policy import (
    base_key,
    describe_base,
    find_base,
    prepare_base,
    with_policy_of,
)
from symsteer.bench.runs.config import RunConfig, build_config
from symsteer.bench.runs.folder import run_id
from symsteer.bench.runs.run import check
from symsteer.bench.tasks import task_class
from symsteer.errors import UserError
from symsteer.leaderboard.records import read_record
from symsteer.policies import POLICIES
from symsteer.policies.files import policy_path
from symsteer.policies.words import sentences
from symsteer.registry import allow
from tests.bench.tiny_run import POLICY, execute, quiet, tiny_config
from tests.marks import slow_except

STRANGER = '''
"""A policy from outside of SymSteer."""

from symsteer.policies.contract import ChunkPolicy


class Echo(ChunkPolicy):
    """Its noise is its action."""

    name = "echo"

    @classmethod
    def fit(cls, options, episodes, obs_layout, act_layout, seed=0, progress=None, device="cpu"):
        progress(1, 1, 0.0)
        return cls(options, obs_layout, act_layout).to(device).freeze()

    def decode(self, obs, noise):
        return noise.clamp(-1, 1)
'''


def test_a_policy_from_another_package(tmp_path, monkeypatch):
    (tmp_path / "stranger_policy.py").write_text(STRANGER)
    monkeypatch.syspath_prepend(tmp_path)
    name = "stranger_policy:Echo"
    allow(name)
    data = tiny_config().to_json() | {"policy": {"name": name, "horizon": 4, "execute": 2}}
    config = build_config(data, "test")
    assert find_base(config, tmp_path) is None
    base = prepare_base(config, quiet(runs=tmp_path))
    assert (base.name, base.horizon, base.execute) == ("echo", 4, 2)
    assert describe_base(base).episodes == 32
    # Found again instead of trained again.
    monkeypatch.setattr(POLICIES.get(name), "fit", None)
    again = prepare_base(config, quiet(runs=tmp_path))
    assert again.content_hash() == base.content_hash()
    # A run that names the file takes its settings; other settings are refused.
    path = policy_path(find_base(config, tmp_path))
    assert with_policy_of(config, path).policy_name == name
    other = build_config(data | {"policy": {"name": name, "horizon": 6, "execute": 2}}, "test")
    with pytest.raises(UserError, match="horizon 4, and this run asks for 6"):
        with_policy_of(other, path)
    # Changed code is another policy.
    (tmp_path / "stranger_policy.py").write_text(STRANGER + "\n")
    assert find_base(config, tmp_path) is None


STEERED = [
    *(("PickCube-v1", name) for name in POLICIES.builtin if name != "edp"),
    *((task, "spherical") for task in ("TiltedPickCube-v1", "TiltedPushCube-v1")),
]
OFTEN = {("PickCube-v1", "canonical"), ("TiltedPickCube-v1", "spherical")}


@pytest.mark.parametrize(
    ("task", "name"),
    [
        pytest.param(*one, marks=pytest.mark.long if one in OFTEN else pytest.mark.slow)
        for one in STEERED
    ],
)
def test_every_policy_is_trained_and_steered(task, name, tmp_path):
    """On a tilted table an equivariant agent uses the turns about the laboratory's vertical."""
    config = tiny_config(policy_name=name, task=task, env_steps=160)
    record = read_record(execute(config, tmp_path) / "record.json")
    assert record.status == "finished"
    assert record.base_policy.name == name
    assert (record.base_policy.group == "C8") or name != "spherical"
    assert record.budget.updates > 0


TASKS = ("PickCube-v1", "PushCube-v1", "PlaceSphere-v1")


def joint(task, tasks=TASKS, name="edp-joint", **changes):
    policy = POLICIES.get(name).Options(**POLICY, tasks=tasks)
    return tiny_config(task=task, policy_name=name, policy=policy, **changes)


@pytest.mark.long
@pytest.mark.parametrize("name", slow_except(["edp-joint", "plain-joint"], "edp-joint"))
def test_it_is_trained_once_for_the_runs_on_all_tasks(name, tmp_path, monkeypatch):
    first = joint("PushCube-v1", name=name)
    assert find_base(first, tmp_path) is None
    base = prepare_base(first, quiet(runs=tmp_path))
    assert base.options.tasks == tuple(sorted(TASKS))
    monkeypatch.setattr(POLICIES.get(name), "fit_tasks", None)
    hashes = {base.content_hash()}
    for task in TASKS:
        other = joint(task, name=name)
        path = find_base(other, tmp_path)
        assert path is not None
        policy = prepare_base(other, quiet(runs=tmp_path))
        assert policy.obs_layout == task_class(task).observation_layout
        assert policy.report["world"]["task"] == task
        assert "steerability" in policy.report
        hashes.add(policy.content_hash())
        if name == "edp-joint":
            assert with_policy_of(other, policy_path(path)).policy == other.policy
    assert len(hashes) == 3
    # Another seed, or other tasks, are other policies.
    assert find_base(joint(TASKS[0], name=name, policy_seed=7), tmp_path) is None
    assert find_base(joint(TASKS[0], TASKS[:2], name=name), tmp_path) is None


@pytest.mark.long
def test_other_demonstrations_of_one_task_are_another_policy_of_all(tmp_path):
    pair = ("PickCube-v1", "PushCube-v1")
    demos = collect("PushCube-v1", "floating", 3, "diverse", 99, tmp_path / "own.h5")
    prepare_base(joint("PushCube-v1", pair), quiet(runs=tmp_path, demos=demos))
    # The runs that begin from the expert's demonstrations do not find it.
    for task in pair:
        prepare_base(joint(task, ()), quiet(runs=tmp_path))
    for task in pair:
        assert find_base(joint(task, pair), tmp_path) is None
        assert find_base(joint(task, ()), tmp_path) is not None


@pytest.mark.long
def test_another_sentence_needs_no_training(tmp_path, monkeypatch):
    pair, name = ("PickCube-v1", "PushCube-v1"), "edp-told"
    first = joint("PushCube-v1", pair, name=name)
    assert first.policy.instruction == sentences("PushCube-v1")[0]
    base = prepare_base(first, quiet(runs=tmp_path))
    monkeypatch.setattr(POLICIES.get(name), "fit_tasks", None)
    options = dataclasses.replace(first.policy, instruction="Nudge the block to the goal.")
    other = dataclasses.replace(first, policy=options)
    assert base_key(other) == base_key(first) == base_key(joint("PickCube-v1", pair, name=name))
    assert run_id(other, {}) != run_id(first, {})
    # A sweep need not train anything for it.
    assert find_base(other, tmp_path) == find_base(first, tmp_path)
    told = prepare_base(other, quiet(runs=tmp_path))
    place = find_base(other, tmp_path)
    assert place != find_base(first, tmp_path)
    assert told.options.instruction == "Nudge the block to the goal."
    assert told.content_hash() != base.content_hash()
    assert told.report["world"] == base.report["world"]
    assert "steerability" in told.report
    # A file keeps its sentence, unless the run asks for another one.
    file, task = policy_path(place), "PushCube-v1"
    assert with_policy_of(tiny_config(task=task), file).policy == other.policy
    plain = RunConfig(task=task, policy_name=name)
    assert with_policy_of(plain, file).policy == other.policy
    asked = dataclasses.replace(plain.policy, instruction="Shove the cube.")
    config = with_policy_of(dataclasses.replace(plain, policy=asked), file)
    assert config.policy == dataclasses.replace(other.policy, instruction="Shove the cube.")
    used = prepare_base(config, quiet(runs=tmp_path, base_policy=file))
    assert used.options.instruction == "Shove the cube."
    with pytest.raises(UserError, match=r"policy\.steps 20, and this run asks for 30"):
        with_policy_of(
            dataclasses.replace(plain, policy=dataclasses.replace(plain.policy, steps=30)), file
        )


def test_the_order_of_tasks_and_the_runs_own_do_not_matter():
    wanted = joint("PickCube-v1")
    for tasks in (TASKS[::-1], TASKS[1:]):
        assert joint("PickCube-v1", tasks) == wanted
        assert run_id(joint("PickCube-v1", tasks), {}) == run_id(wanted, {})
    assert build_config(wanted.to_json(), "test") == wanted
    alone = joint("PickCube-v1", ())
    assert alone.policy.tasks == ()
    assert alone.policy_tasks == ("PickCube-v1",)
    # Other policies have no such option.
    with pytest.raises(UserError, match=r"policy\.tasks"):
        build_config({"policy": {"name": "edp", "tasks": ["PushCube-v1"]}}, "test")


def test_tasks_that_cannot_be_joined_are_refused():
    with pytest.raises(UserError, match=r"'PushCub-v1'.*did you mean 'PushCube-v1'"):
        check(joint("PickCube-v1", ("PushCub-v1",)))
    other = "tests.bench.tasks.lab:OtherActions"
    allow(other)
    with pytest.raises(UserError, match=f"the actions of {other} have another layout than those"):
        check(joint("PickCube-v1", (other,)))


def test_processes_that_need_the_same_policy_at_the_same_time_build_it_once(tmp_path, monkeypatch):
    built = []

    def counted(make):
        return lambda *given, **options: built.append(make.__name__) or make(*given, **options)

    for name in ("collect", "_train"):
        monkeypatch.setattr(base_policy, name, counted(getattr(base_policy, name)))
    with ThreadPoolExecutor(3) as machines:
        how = quiet(runs=tmp_path)
        policies = list(machines.map(lambda _: prepare_base(tiny_config(), how), range(3)))
    assert built == ["collect", "_train"]
    assert len({policy.content_hash() for policy in policies}) == 1
