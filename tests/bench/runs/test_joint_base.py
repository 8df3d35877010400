"""A base policy of several tasks: trained once, steered on each."""

import pytest

from symsteer.bench.demos import collect
from symsteer.bench.runs.base_policy import find_base, prepare_base, with_policy_of
from symsteer.bench.runs.config import build_config
from symsteer.bench.runs.folder import run_id
from symsteer.bench.runs.run import check, execute
from symsteer.bench.tasks import task_class
from symsteer.errors import UserError
from symsteer.leaderboard.records import read_record
from symsteer.policies import POLICIES
from symsteer.policies.files import policy_path
from symsteer.registry import allow
from tests.bench.tiny_run import POLICY, tiny_config
from tests.marks import slow_except

pytestmark = pytest.mark.long

TASKS = ("PickCube-v1", "PushCube-v1", "PlaceSphere-v1")


def config(task, tasks=TASKS, name="edp-joint", **changes):
    policy = POLICIES.get(name).Options(**POLICY, tasks=tasks)
    return tiny_config(task=task, policy_name=name, policy=policy, **changes)


@pytest.mark.parametrize("name", slow_except(["edp-joint", "plain-joint"], "edp-joint"))
def test_it_is_trained_once_for_the_runs_on_all_tasks(name, tmp_path, monkeypatch):
    first = config("PushCube-v1", name=name)
    assert find_base(first, tmp_path) is None
    base = prepare_base(first, tmp_path, progress=False)
    assert base.options.tasks == tuple(sorted(TASKS))
    monkeypatch.setattr(POLICIES.get(name), "fit_tasks", None)
    hashes = {base.content_hash()}
    for task in TASKS:
        other = config(task, name=name)
        path = find_base(other, tmp_path)
        assert path is not None
        policy = prepare_base(other, tmp_path, progress=False)
        assert policy.obs_layout == task_class(task).observation_layout
        assert policy.report["world"]["task"] == task
        # Its report is kept, and it is that of its own task.
        assert "steerability" in (again := prepare_base(other, tmp_path, progress=False)).report
        assert again.content_hash() == policy.content_hash()
        hashes.add(policy.content_hash())
        if name == "edp-joint":
            assert with_policy_of(other, policy_path(path)).policy == other.policy
    assert len(hashes) == 3
    # Another seed, or other tasks, are other policies.
    assert find_base(config(TASKS[0], name=name, policy_seed=7), tmp_path) is None
    assert find_base(config(TASKS[0], TASKS[:2], name=name), tmp_path) is None


def test_other_demonstrations_of_one_task_are_another_policy_of_all(tmp_path):
    pair = ("PickCube-v1", "PushCube-v1")
    own = collect("PushCube-v1", "floating", 3, "diverse", 99, tmp_path / "own.h5")
    prepare_base(config("PushCube-v1", pair), tmp_path, own, progress=False)
    # The runs that begin from the expert's demonstrations do not find it.
    for task in pair:
        prepare_base(config(task, ()), tmp_path, progress=False)
    for task in pair:
        assert find_base(config(task, pair), tmp_path) is None
        assert find_base(config(task, ()), tmp_path) is not None


def test_the_order_of_tasks_and_the_runs_own_do_not_matter():
    wanted = config("PickCube-v1")
    for tasks in (TASKS[::-1], TASKS[1:]):
        assert config("PickCube-v1", tasks) == wanted
        assert run_id(config("PickCube-v1", tasks), {}) == run_id(wanted, {})
    assert build_config(wanted.to_json(), "test") == wanted
    alone = config("PickCube-v1", ())
    assert alone.policy.tasks == ()
    assert alone.policy_tasks == ("PickCube-v1",)
    # Other policies have no such option.
    with pytest.raises(UserError, match=r"policy\.tasks"):
        build_config({"policy": {"name": "edp", "tasks": ["PushCube-v1"]}}, "test")


def test_tasks_that_cannot_be_joined_are_refused():
    with pytest.raises(UserError, match=r"'PushCub-v1'.*did you mean 'PushCube-v1'"):
        check(config("PickCube-v1", ("PushCub-v1",)))
    other = "tests.bench.tasks.lab:OtherActions"
    allow(other)
    with pytest.raises(UserError, match=f"the actions of {other} have another layout than those"):
        check(config("PickCube-v1", (other,)))


@pytest.mark.parametrize("task", slow_except(TASKS, TASKS[0]))
def test_it_is_steered_on_each_task(task, tmp_path):
    wanted = config(task, env_steps=160)
    record = read_record(execute(wanted, tmp_path, progress=False) / "record.json")
    assert record.status == "finished"
    assert (record.base_policy.name, record.base_policy.group) == ("edp-joint", "C8")
    assert record.budget.updates > 0
