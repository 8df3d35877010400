"""Sweeps with real runs: failures, workers that are killed, Ctrl-C, skipped runs."""

import contextlib
import multiprocessing
import os
import re
import shutil
import signal
import subprocess
import sys
import threading

import psutil
import pytest

from symsteer.bench.runs.base_policy import demonstration_path
from symsteer.bench.runs.config import DemonstrationConfig
from symsteer.bench.runs.folder import CHECKPOINT, state_of
from symsteer.bench.sweep.plan import Plan, make_plan
from symsteer.bench.sweep.pool import LocalPool
from symsteer.bench.sweep.schedule import EndedRun, Task, Watcher, execute_plan
from symsteer.bench.sweep.status import read_status, to_text
from symsteer.bench.sweep.suite import Suite, load_suite
from symsteer.bench.sweep.work import Result
from symsteer.bench.throughput import Setting
from symsteer.leaderboard.records import read_record
from tests.bench.sweep.long_run import LONG, wait_for
from tests.bench.tiny_run import tiny_config, without_clock, write_suite


class Witness(Watcher):
    """Remembers what a sweep with one worker did."""

    def __init__(self):
        self.tasks: list[tuple[str, str]] = []
        self.again: list[tuple[str, str]] = []
        self.running: list[Task] = []

    def refresh(self, running: list[Task]) -> None:
        if running and running != self.running:
            [task] = running
            agents = " ".join(run.agent for run in task.runs) if task.kind == "run" else ""
            self.tasks.append((task.kind, agents))
        self.running = running

    def retried(self, task: Task, result: Result) -> None:
        self.again.append((task.kind, result.reason))
        self.running = []


def work(plan: Plan, tmp_path, together=1) -> tuple[list[EndedRun], Witness]:
    """Execute a plan with one worker."""
    pool, witness = LocalPool(1, tmp_path / "log"), Witness()
    try:
        return list(execute_plan(plan, plan.runs, pool, witness, together)), witness
    finally:
        pool.stop()


def workers() -> list[int]:
    return [process.pid for process in multiprocessing.active_children()]


@pytest.mark.slow
def test_a_team_goes_on_without_what_fails(tmp_path):
    """Only the run that fails is tried again, and those whose base policy failed are left out."""
    configs = tuple(tiny_config("standard", seed=seed) for seed in range(4))
    plan = make_plan(Suite("team", "", configs), tmp_path / "runs")
    (plan.out / plan.runs[1].run_id / CHECKPOINT).mkdir(parents=True)
    demonstration_path(configs[3], plan.out).mkdir(parents=True)
    ends, witness = work(plan, tmp_path, together=4)
    states = {end.run.seed: end.status for end in ends}
    assert states == {0: "finished", 1: "failed", 2: "finished", 3: "failed"}
    assert witness.tasks[-2:] == [("run", "standard standard standard"), ("run", "standard")]
    assert any(CHECKPOINT in end.reason for end in ends)
    record = read_record(plan.out / plan.runs[0].run_id / "record.json")
    assert (record.status, record.provenance.together) == ("finished", 3)


@pytest.mark.long
def test_failures_are_isolated_and_a_killed_worker_loses_nothing(undisturbed, tmp_path):
    # Both pass every check on the configuration, and something is in their way: of the run's own
    # checkpoint, and of its demonstrations.
    bad = tiny_config(agent="standard")
    baseless = tiny_config(
        agent="zero", variant="wind:1", demonstrations=DemonstrationConfig(count=3, seed=1)
    )
    out = tmp_path / "runs"
    obstacle = demonstration_path(baseless, out)
    obstacle.mkdir(parents=True)
    plan = make_plan(Suite("mixed", "", (LONG, bad, tiny_config(agent="zero"), baseless)), out)
    folder = out / plan.runs[0].run_id
    (out / plan.runs[1].run_id / CHECKPOINT).mkdir(parents=True)
    killed = []

    def kill() -> None:
        wait_for((folder / CHECKPOINT).is_file)
        killed.extend(workers())
        os.kill(killed[0], signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    ends, witness = work(plan, tmp_path)
    killer.join()
    by_name = {f"{end.run.agent} {end.run.variant}": end for end in ends}
    assert len(killed) == 1
    assert {name: end.status for name, end in by_name.items()} == {
        "equivariant none": "finished",
        "standard none": "failed",
        "zero none": "finished",
        "zero wind:1": "failed",
    }
    # The killed run continued from its checkpoint, and nobody can tell.
    assert read_record(folder / "record.json").wall_clock.resumed == 1
    assert without_clock(folder) == without_clock(undisturbed)
    assert CHECKPOINT in by_name["standard none"].reason
    reason = by_name["zero wind:1"].reason
    assert reason.startswith("its demonstrations failed: ")
    assert obstacle.name in reason
    # What is shared was built once and first; what failed was tried once more, at the end.
    assert witness.tasks == [
        ("demonstrations", ""),
        ("demonstrations", ""),
        ("base policy", ""),
        ("run", "equivariant"),
        ("run", "standard"),
        ("run", "zero"),
        ("demonstrations", ""),
        ("run", "equivariant"),
        ("run", "standard"),
    ]
    assert [kind for kind, _ in witness.again] == ["demonstrations", "run", "run"]
    assert "killed by SIGKILL" in witness.again[1][1]
    assert workers() == []


@pytest.mark.long
@pytest.mark.parametrize(
    "end", [signal.SIGINT, pytest.param(signal.SIGKILL, marks=pytest.mark.slow)]
)
def test_a_stopped_sweep_leaves_no_process_and_goes_on(end, undisturbed, tmp_path):
    """Ctrl-C reaches all processes of the terminal's group, a kill only the sweep itself."""
    path = write_suite(tmp_path, LONG, 'agent = ["equivariant"]\nseed = [0, 1]')
    out = tmp_path / "runs"
    shutil.copytree(undisturbed.parent / "base", out / "base")
    # A test suite that runs in the background has its children ignore interrupts.
    program = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from symsteer.launch import main; "
        f"sys.argv = ['symsteer', 'sweep', {path!r}, '--runs', {str(out)!r}, '--workers', '1']; "
        "sys.exit(main())"
    )
    sweep = subprocess.Popen(
        [sys.executable, "-c", program],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    folder = out / undisturbed.name
    try:
        wait_for(lambda: (folder / CHECKPOINT).is_file() or sweep.poll() is not None)
        assert state_of(folder) == "running"
        [status] = read_status(out).sweeps
        assert [len(status.in_state(state)) for state in ("running", "missing")] == [1, 1]
        if end == signal.SIGINT:
            os.killpg(sweep.pid, end)
        else:
            sweep.kill()
        output, errors = sweep.communicate(timeout=60)
        wait_for(lambda: not group(sweep.pid), seconds=10)
    finally:
        sweep.kill()
    if end == signal.SIGINT:
        assert sweep.returncode == 130
        assert errors.splitlines() == [
            "interrupted",
            "the same command continues the sweep",
        ]
        assert output == ""
    text = to_text(read_status(out).sweeps, out)
    assert "interrupted      1" in text
    assert "missing          1" in text


def group(leader: int) -> list[int]:
    """The living processes of a process group."""
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error, ProcessLookupError):
            if os.getpgid(process.pid) == leader and process.status() != psutil.STATUS_ZOMBIE:
                found.append(process.pid)
    return found


def test_the_command_line(undisturbed, command, tmp_path):
    """Finished runs are skipped, failed ones are named with their reason, and counted."""
    path = write_suite(tmp_path, LONG, 'agent = ["equivariant"]\nenv_steps = [320, 321]')
    out = tmp_path / "runs"
    shutil.copytree(undisturbed, out / undisturbed.name)
    other = make_plan(load_suite(path), out).runs[1]
    # Whoever comes to this folder cannot make a run of it.
    (out / other.run_id).write_text("in the way")
    before = sorted(out.rglob("*"))
    trial = ("sweep", path, "--runs", out, "--dry-run")
    code, shown = command(*trial)
    assert code == 0
    assert re.search(r"env_steps +320 +1 +1 +0 +0 +0\n +321 +1 +0 +0 +0 +1\n", shown.out)
    assert "base policies to build: 1\n    1 edp for PickCube-v1 floating, 3 diverse" in shown.out
    assert "estimated from 1 finished run" in shown.out
    cluster = (*trial, "--ray", "no-such-head:6379")
    assert "time: depends on the size of the cluster" in command(*cluster)[1].out
    assert "with 7 workers, estimated from" in command(*cluster, "--workers", 7)[1].out
    assert sorted(out.rglob("*")) == before
    record = (out / undisturbed.name / "record.json").stat().st_mtime_ns
    shutil.copytree(undisturbed.parent / "base", out / "base")
    code, shown = command("sweep", path, "--runs", out, "--workers", 1)
    assert code == 1
    skipped, failed = shown.out.splitlines()
    assert skipped == "skipped   1 of 2 runs are finished already"
    assert failed.startswith(f"failed    [2/2] {other.label}  cannot write")
    reason = failed.partition(f"{other.label}  ")[2]
    assert shown.err.splitlines() == [f"failed: {other.label}: {reason}"]
    assert (out / undisturbed.name / "record.json").stat().st_mtime_ns == record
    assert f"failed:\n  {other.label}: cannot write" in command("status", out)[1].out
    assert workers() == []


@pytest.mark.parametrize(
    ("options", "tried", "used"),
    [
        ((), {"workers": [2, 1], "together": [1, 2]}, (1, 2)),
        (("--together", 5), {"workers": [2, 1], "together": [5]}, (1, 5)),
        (("--together", 1), {"workers": [2, 1], "together": [1]}, (1, 1)),
    ],
)
def test_the_fastest_setting_reaches_the_pool(options, tried, used, command, monkeypatch, tmp_path):
    """With five runs and two cores, teams of five would leave a core without work."""
    path = write_suite(tmp_path, tiny_config("standard"), "seed = [0, 1, 2, 3, 4]")
    measured, begun = [], []

    def measure(run, choices, *rest):
        measured.append((run.agent, choices))
        settings = [Setting("cpu", 4, w, t) for w in (1, 2) for t in choices["together"][::-1]]
        return {setting: 9.0 - index for index, setting in enumerate(settings)}

    def execute(plan, todo, pool, display, together):
        begun.append((pool.capacity, together))
        return iter(())

    monkeypatch.setattr("symsteer.bench.throughput.measure", measure)
    monkeypatch.setattr("symsteer.bench.sweep.command._cores", lambda: 2)
    monkeypatch.setattr("symsteer.bench.sweep.command.execute_plan", execute)
    sweep = ("sweep", path, "--runs", tmp_path / "runs", "--workers", "auto", *options)
    shown = command(*sweep, "--dry-run")[1]
    assert not measured
    assert f"tries [2, 1] at a time, {tried['together']} together" in shown.err
    assert command(*sweep)[0] == 0
    [(agent, choices)] = measured
    assert agent == "standard"
    assert choices == {"device": ["cpu"], "num_envs": [4], **tried}
    assert begun == [used]


def test_nothing_is_measured_if_every_learner_has_a_core(command, monkeypatch, tmp_path):
    path = write_suite(tmp_path, tiny_config("standard"), 'agent = ["standard", "base", "zero"]')
    begun, measured = [], []
    monkeypatch.setattr("symsteer.bench.throughput.measure", lambda *given: measured.append(given))
    monkeypatch.setattr("symsteer.bench.sweep.command._cores", lambda: 2)
    monkeypatch.setattr(
        "symsteer.bench.sweep.command.execute_plan",
        lambda plan, todo, pool, display, together: begun.append((pool.capacity, together)) or [],
    )
    assert command("sweep", path, "--runs", tmp_path / "runs", "--workers", "auto")[0] == 0
    assert (begun, measured) == ([(2, 1)], [])


@pytest.mark.parametrize(
    ("run", "options", "words"),
    [
        ("embodiment = 'hand'", [], "there is no embodiment 'hand'"),
        ("task = 'PickCub-v1'", [], "PickCube-v1"),
        ("agent = 'ppo'", ["--dry-run"], "there is no agent"),
        ("", ["--workers", "-1"], "--workers is -1"),
        ("", ["--workers", "-1", "--dry-run"], "--workers is -1"),
        ("", ["--workers", "auto", "--together", "0"], "--together is 0"),
        (
            "",
            ["--workers", "auto", "--ray", "auto"],
            "--workers auto is for a sweep on this machine",
        ),
        ("", ["--workers", "auto", "--ray", "auto", "--dry-run"], "--workers auto is for"),
        ("num_envs = 600", ["--dry-run"], "1258 are needed while those of 600 .* lower num_envs"),
        ("num_envs = 300", ["--together", "2"], "1016 are needed .* lower --together"),
        ("", ["--ray", "here"], "--ray here is not an address"),
        ("", ["--ray", "here", "--dry-run"], "--ray here is not an address"),
    ],
)
def test_what_cannot_run_is_refused_before_anything_happens(run, options, words, command, tmp_path):
    path = tmp_path / "bad.toml"
    path.write_text(f"[grid]\nseed = [0, 1]\n[run]\n{run}")
    code, shown = command("sweep", path, "--runs", tmp_path / "runs", *options)
    assert (code, shown.out) == (2, "")
    assert re.search(words, shown.err)
    assert shown.err.count("\n") == 1
