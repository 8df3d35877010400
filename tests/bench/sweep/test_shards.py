"""A suite in shares, for machines that do not know of each other."""

import os
import subprocess
import sys

import pytest

from symsteer.bench.runs.base_policy import base_key
from symsteer.bench.sweep.plan import make_plan, share_of, shares, write_sweep
from symsteer.bench.sweep.status import read_status
from symsteer.bench.sweep.suite import Suite, load_suite
from symsteer.errors import UserError
from tests.bench.tiny_run import tiny_config


@pytest.fixture(scope="module")
def plans(tmp_path_factory):
    out = tmp_path_factory.mktemp("runs")
    return [make_plan(load_suite(name), out) for name in ("smoke", "core", "policies")]


def test_shares_are_disjoint_and_complete(plans):
    for plan in plans:
        for count in (1, 2, 3, 16, len(plan.runs), len(plan.runs) + 3):
            split = shares(plan, count)
            together = [run for share in split for run in share.runs]
            assert len(split) == count
            assert len(together) == len(set(together))
            assert set(together) == set(plan.runs)
            assert len({share.path for share in split} | {plan.path}) == count + 1
            assert [share_of(plan, f"{n}/{count}") for n in (1, count)] == [split[0], split[-1]]


def test_a_base_policy_stays_on_one_machine_and_the_others_have_as_much_to_do(plans):
    for plan in plans:
        bases = {base_key(config) for config in plan.configs.values()}
        for count in (2, 3, len(bases)):
            keys = [{base_key(c) for c in share.configs.values()} for share in shares(plan, count)]
            if count <= len(bases):
                assert sum(map(len, keys)) == len(bases)
        many = len(bases) + 1
        sizes = [len(share.runs) for share in shares(plan, many)]
        assert max(sizes) - min(sizes) <= 1


@pytest.mark.long
def test_another_machine_agrees(plans):
    """Python orders sets differently in every process."""
    say = (
        "from pathlib import Path; from symsteer.bench.sweep.plan import make_plan, share_of;"
        "from symsteer.bench.sweep.suite import load_suite;"
        "plan = make_plan(load_suite('core'), Path('nowhere'));"
        "print(*[run.run_id for run in share_of(plan, '3/7').runs])"
    )
    seed = {"PYTHONHASHSEED": "1"}
    told = subprocess.check_output([sys.executable, "-c", say], text=True, env=os.environ | seed)
    assert told.split() == [run.run_id for run in shares(plans[1], 7)[2].runs]


@pytest.mark.parametrize("shard", ["0/3", "4/3", "3", "1/0", "-1/3", "1/2/3", "a/b"])
def test_what_is_no_share_is_refused(shard, command, tmp_path):
    code, shown = command("sweep", "smoke", "--runs", tmp_path / "runs", f"--shard={shard}")
    assert code == 2
    assert shown.err == f"error: --shard {shard} is no share; 3/16 is the third of 16\n"
    assert not (tmp_path / "runs").exists()


def test_status_puts_shares_together(tmp_path, command):
    configs = [tiny_config(seed=seed) for seed in range(5)]
    plan = make_plan(Suite("five", "", tuple(configs)), tmp_path)
    one, two, three = shares(plan, 3)
    write_sweep(one, 4, {one.runs[0].run_id: "its process died"})
    write_sweep(two, 4, {})
    [status] = read_status(tmp_path, "five").sweeps
    assert set(status.runs) == {*one.runs, *two.runs}
    assert status.in_state("failed") == one.runs[:1]
    # Another try of the same share forgets it; the list of the whole suite has all of them.
    write_sweep(one, 4, {})
    assert not read_status(tmp_path).sweeps[0].in_state("failed")
    write_sweep(plan, 4, {})
    write_sweep(three, 4, {three.runs[0].run_id: "no"})
    [status] = read_status(tmp_path).sweeps
    assert len(status.runs) == 5
    assert status.in_state("failed") == three.runs[:1]
    assert command("status", tmp_path)[1].out.startswith("five (5 runs)\n")
    with pytest.raises(UserError, match="did you mean 'five'"):
        read_status(tmp_path, "fiv")


def test_a_share_is_a_sweep(command, tmp_path):
    words = ("sweep", "smoke", "--runs", tmp_path, "--dry-run")
    counted = [command(*words, "--shard", f"{n}/3")[1].out for n in (1, 2, 3)]
    assert sum(int(text.split("\nall")[1].split()[0]) for text in counted) == 4
    assert not list(tmp_path.iterdir())
