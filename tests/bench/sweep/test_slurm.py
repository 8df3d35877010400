"""A suite as a Slurm array: with stand-ins for Slurm's commands, and with a Slurm of its own.

The real Slurm has one node, this machine, and its configuration in a folder of the test. The tests
with it are skipped where any other Slurm is configured.
"""

import dataclasses
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from symsteer.bench.runs.folder import CHECKPOINT, RECORD, is_finished
from symsteer.bench.sweep import array_task, slurm
from symsteer.bench.sweep.array_task import AGAIN, ArrayTask
from symsteer.bench.sweep.plan import make_plan, sweep_path
from symsteer.bench.sweep.suite import load_suite
from symsteer.files import read_model
from symsteer.leaderboard.records import read_record
from tests.bench.sweep.long_run import LONG, wait_for
from tests.bench.tiny_run import execute, tiny_config, without_clock, write_suite

LONGER = dataclasses.replace(
    LONG, env_steps=30_000, evaluation=dataclasses.replace(LONG.evaluation, every=30_000)
)
"""Long enough for Slurm, which looks for jobs that are over their time every 30 seconds."""


@pytest.fixture
def no_slurm(monkeypatch, tmp_path):
    """A folder of commands that stand for Slurm's; at first there are none."""
    folder = tmp_path / "bin"
    folder.mkdir()
    monkeypatch.setenv("PATH", f"{folder}:/usr/bin-without-slurm:/bin-without-slurm")
    return folder


@pytest.fixture
def fake(no_slurm):
    """An sbatch that keeps the script and numbers arrays, and a squeue with a list of jobs."""
    pytest.importorskip("submitit", exc_type=ImportError)

    def write(name, text):
        path = no_slurm / name
        path.write_text(f"#!{sys.executable}\nimport sys\nfrom pathlib import Path\n{text}")
        path.chmod(0o755)

    write("srun", "")
    write("squeue", f"print(Path({str(no_slurm / 'queue')!r}).read_text())")
    write(
        "sbatch",
        f"count = Path({str(no_slurm / 'count')!r})\n"
        "number = int(count.read_text()) + 1 if count.is_file() else 1\n"
        "count.write_text(str(number))\n"
        "script = Path(sys.argv[1]).read_text()\n"
        f"Path({str(no_slurm / 'script')!r}).write_text(script)\n"
        "if 'refused' in script:\n    sys.exit('sbatch: error: it is refused')\n"
        "print('Submitted batch job', number)",
    )
    (no_slurm / "queue").write_text("")
    return no_slurm


def five(tmp_path) -> tuple[str, Path]:
    """The path of a suite with five runs, and the folder of its runs."""
    return write_suite(tmp_path, tiny_config(), "seed = [0, 1, 2, 3, 4]"), tmp_path / "runs"


def launcher(tmp_path, text) -> str:
    path = tmp_path / "cluster.toml"
    path.write_text(text)
    return str(path)


def jobs_of(out, suite="tiny"):
    return json.loads(sweep_path(out, suite).read_text())["jobs"]


def test_the_settings_that_come_with_symsteer_are_the_defaults_and_have_a_page():
    file, path = read_model("slurm", "launcher", slurm.LAUNCHERS, slurm.SlurmFile)
    assert file == slurm.SlurmFile()
    page = Path(__file__).parents[3] / "docs" / "clusters.md"
    for text in (path.read_text(), page.read_text()):
        assert [key for key in slurm.SlurmFile.model_fields if key not in text] == []


def test_one_array_has_all_runs_and_the_same_command_queues_what_is_lost(fake, command, tmp_path):
    suite, out = five(tmp_path)
    file = launcher(tmp_path, 'cpus = 2\ntime = "30"\nsetup = ["module load x"]')
    words = ("sweep", suite, "--runs", out, "--launcher", file)
    code, shown = command(*words, "--dry-run")
    assert (code, out.exists()) == (0, False)
    assert shown.out.endswith("an array of up to 3 tasks, each with 2 runs at a time\n")
    code, shown = command(*words)
    assert (code, shown.err) == (0, "")
    assert shown.out.startswith(
        "0 runs finished, 0 in the queue before, 5 queued now as array 1 of 3\n"
    )
    assert sorted(jobs_of(out).values()) == ["1_0", "1_0", "1_1", "1_2", "1_2"]
    script = (fake / "script").read_text()
    for line in ("--array=0-2%3", "--time=30", "--cpus-per-task=2", "--mem=16G", "--requeue"):
        assert f"#SBATCH {line}\n" in script
    assert "#SBATCH --signal=USR2@90\n" in script
    assert "\nexport PYTHONSAFEPATH=1\nmodule load x\n" in script
    # From Slurm 22.05 on, srun does not know the number of processors from sbatch.
    assert re.search(r"^srun .*--cpus-per-task=2 ", script, re.MULTILINE)
    # Two tasks wait or work: nothing is queued twice. The third was ended by somebody.
    (fake / "queue").write_text("1_0\n1_1\n1_2\n")
    assert "5 in the queue before, 0 queued now\n" in command(*words)[1].out
    (fake / "queue").write_text("1_0\n1_2\n")
    assert "  queued           4\n  lost             1\n" in command("status", out)[1].out
    assert "4 in the queue before, 1 queued now as array 2 of 1\n" in command(*words)[1].out
    assert sorted(jobs_of(out).values()) == ["1_0", "1_0", "1_2", "1_2", "2"]


def test_a_task_is_a_sweep_of_its_share(fake, command, tmp_path, monkeypatch):
    suite, out = five(tmp_path)
    handed = []
    monkeypatch.setattr(slurm, "_submit", lambda tasks, *_: handed.extend(tasks) or ["1_0", "1_1"])
    file = launcher(tmp_path, "cpus = 3")
    command("sweep", suite, "--runs", out, "--launcher", file, "--together", 1, "--trust", "a:B")
    plan = make_plan(load_suite(suite), out)
    kept = [path for task in handed for path in task.checkpoints]
    assert sorted(kept) == sorted(out / run.run_id / CHECKPOINT for run in plan.runs)
    Path(suite).write_text("the tasks have a copy")
    for task in handed:
        code, shown = command(*task.words, "--dry-run")
        assert code == 0
        assert int(shown.out.split("\nall")[1].split()[0]) == len(task.checkpoints)
        assert task.words[-2:] == ("--shard", f"{handed.index(task) + 1}/2")


def test_a_suite_that_changes_under_its_jobs_is_refused(fake, command, tmp_path):
    suite, out = five(tmp_path)
    words = ("sweep", suite, "--runs", out, "--launcher", launcher(tmp_path, "cpus = 2"))
    command(*words)
    (fake / "queue").write_text("1_0\n")
    Path(suite).write_text(Path(suite).read_text().replace("[0, 1, 2, 3, 4]", "[0, 1, 2, 3, 5]"))
    code, shown = command(*words)
    assert code == 2
    assert "the suite tiny has changed since it was queued" in shown.err
    (fake / "queue").write_text("")
    assert command(*words)[0] == 0


@pytest.mark.parametrize(
    ("text", "words", "says"),
    [
        ("cpu = 2", [], "cpus"),
        ("cpus = 0", [], "cpus: Input should be greater than or equal to 1"),
        ("[sbatch]\narray = '0-3'", [], "array is set by SymSteer; leave it out"),
        ("image = 'no.sif'", [], "there is no image no.sif; correct `image`, or leave it out"),
        ("partition = 'refused'", [], "Slurm refuses the array (sbatch: error: it is refused)"),
        ("", ["--workers", "auto"], "--workers auto is for a sweep on this machine alone"),
        ("", ["--ray", "auto"], "leave --ray and --shard out"),
        ("", ["--shard", "1/2"], "leave --ray and --shard out"),
    ],
)
def test_what_is_wrong_is_one_sentence(text, words, says, fake, command, tmp_path):
    suite, out = five(tmp_path)
    file = launcher(tmp_path, text)
    code, shown = command("sweep", suite, "--runs", out, "--launcher", file, *words)
    assert (code, shown.out) == (2, "")
    assert says in shown.err
    assert shown.err.count("\n") == 1
    assert not list(out.glob("sweeps/*.json"))


def test_without_slurm_or_submitit_it_is_said(no_slurm, command, tmp_path, monkeypatch):
    suite, out = five(tmp_path)
    words = ("sweep", suite, "--runs", out, "--launcher", "slurm")
    with monkeypatch.context() as patch:
        patch.setitem(sys.modules, "submitit", None)
        assert 'pip install "symsteer[slurm]"' in command(*words)[1].err
    pytest.importorskip("submitit", exc_type=ImportError)
    code, shown = command(*words)
    assert code == 2
    assert "this machine has no Slurm (srun is not found)" in shown.err


def test_where_slurm_is_silent_status_shows_what_it_knows(fake, command, tmp_path):
    suite, out = five(tmp_path)
    command("sweep", suite, "--runs", out, "--launcher", launcher(tmp_path, "cpus = 5"))
    (fake / "squeue").write_text("#!/bin/sh\necho 'squeue: error: no answer' >&2\nexit 1")
    code, shown = command("status", out)
    assert code == 0
    assert "  missing          5\nqueued and lost runs are not known: Slurm does not" in shown.out
    (fake / "squeue").unlink()
    assert "no Slurm (squeue is not found)" in command("status", out)[1].out


def test_a_container_gets_the_folder_and_the_gpu(fake, command, tmp_path):
    suite, out = five(tmp_path)
    image = tmp_path / "an image.sif"
    image.touch()
    file = launcher(tmp_path, f"image = {str(image)!r}\ngpus = 1\n[sbatch]\naccount = 'robots'")
    assert command("sweep", suite, "--runs", out, "--launcher", file)[0] == 0
    script = (fake / "script").read_text()
    assert f" apptainer exec --nv --bind {out} '{image}' python -u -m submitit" in script
    assert "#SBATCH --account=robots\n" in script
    assert "#SBATCH --gpus-per-node=1\n" in script


@pytest.mark.parametrize(
    ("program", "code"),
    [
        # It saves, ends as a sweep does when it is terminated, and is queued again.
        ("echo > '{out}/a/checkpoint.pt'; sleep 0.2; kill -USR2 $PPID; sleep 60", AGAIN),
        ("kill -USR2 $PPID; sleep 60", "the task has saved nothing in its time; give it more"),
        # Pre-empted, it is terminated by Slurm.
        ("kill -TERM $$; sleep 60", AGAIN),
        # It ended before the warning reached it, or without one.
        ("trap 'exit 0' TERM; kill -USR2 $PPID; sleep 1", 0),
        ("kill -USR2 $$; exit 1", 1),
    ],
)
def test_a_task_that_is_warned_is_queued_again_unless_that_is_of_no_use(
    program, code, monkeypatch, tmp_path
):
    (tmp_path / "a").mkdir()
    shell = tmp_path / "python"
    ends = "trap 'kill $!; exit 143' TERM\n"
    lines = program.format(out=tmp_path).replace("sleep 60", "sleep 60 & wait")
    shell.write_text(f"#!/bin/sh\n{ends}{lines}\n")
    shell.chmod(0o755)
    monkeypatch.setattr(array_task.sys, "executable", str(shell))
    before = signal.getsignal(signal.SIGUSR2)
    try:
        with pytest.raises(SystemExit) as ended:
            ArrayTask(("sweep",), (tmp_path / "a" / CHECKPOINT,), tmp_path / "base")()
    finally:
        signal.signal(signal.SIGUSR2, before)
    assert str(ended.value.code).startswith(str(code))


@pytest.fixture(scope="module")
def real_slurm(tmp_path_factory):
    """A Slurm with one node of two processors, without an accounting database."""
    pytest.importorskip("submitit", exc_type=ImportError)
    if not (shutil.which("slurmctld", path="/usr/sbin") and shutil.which("srun")):
        pytest.skip("Slurm is not installed")
    if os.geteuid():
        pytest.skip("slurmd must be started by root")
    answers = subprocess.run(["sinfo"], capture_output=True, check=False, timeout=120).returncode
    if "SLURM_CONF" in os.environ or Path("/etc/slurm/slurm.conf").exists() or not answers:
        pytest.skip("a Slurm is configured here")
    folder, host = tmp_path_factory.mktemp("slurm"), socket.gethostname().partition(".")[0]
    with socket.create_server(("127.0.0.1", 0)) as a, socket.create_server(("127.0.0.1", 0)) as b:
        ports = a.getsockname()[1], b.getsockname()[1]
    settings = {
        "ClusterName": "symsteer-test",
        "SlurmctldHost": f"{host}(127.0.0.1)",
        "SlurmctldPort": ports[0],
        "SlurmdPort": ports[1],
        "AuthType": "auth/none",
        "CredType": "cred/none",
        # A task that is queued again waits as long.
        "AuthInfo": "cred_expire=5",
        "PreemptType": "preempt/partition_prio",
        "PreemptMode": "REQUEUE",
        "SlurmUser": "root",
        "StateSaveLocation": folder / "state",
        "SlurmdSpoolDir": folder / "spool",
        "SlurmctldPidFile": folder / "slurmctld.pid",
        "SlurmdPidFile": folder / "slurmd.pid",
        "ProctrackType": "proctrack/linuxproc",
        "TaskPlugin": "task/none",
        "SelectType": "select/cons_tres",
        "SelectTypeParameters": "CR_CPU",
        "JobAcctGatherType": "jobacct_gather/none",
        "ReturnToService": 2,
        "KillWait": 15,
    }
    lines = [f"{key}={value}" for key, value in settings.items()]
    lines += [f"NodeName={host} NodeAddr=127.0.0.1 CPUs=2 RealMemory=4000"]
    lines += [f"PartitionName=main Nodes={host} Default=YES PriorityTier=1 GraceTime=60"]
    lines += [f"PartitionName=first Nodes={host} PriorityTier=2 PreemptMode=OFF"]
    (folder / "slurm.conf").write_text("\n".join(lines) + "\n")
    for name in ("state", "spool"):
        (folder / name).mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("SLURM_CONF", str(folder / "slurm.conf"))
        daemons = []
        for words in (["slurmctld", "-D"], ["slurmd", "-D", "-N", host]):
            with (folder / f"{words[0]}.log").open("w") as log:
                command = [f"/usr/sbin/{words[0]}", *words[1:]]
                daemons.append(subprocess.Popen(command, stdout=log, stderr=log))
        try:
            wait_for(lambda: told("sinfo", "-h", "-o", "%T") == "idle", 60)
            yield host
        finally:
            told("scancel", "--user=root")
            try:
                wait_for(lambda: not told("squeue", "-h"), 300)
            finally:
                for daemon in reversed(daemons):
                    daemon.terminate()
                    daemon.wait(60)


def told(*words) -> str:
    """What a command of Slurm prints."""
    return subprocess.run(words, capture_output=True, text=True, check=False).stdout.strip()


def state_in(out, suite):
    """The number of runs by state."""
    from symsteer.bench.sweep.status import read_status

    [status] = read_status(out, suite).sweeps
    return {state: len(status.in_state(state)) for state in ("running", "queued", "lost")}


def wait_long(condition):
    """As `wait_for`: imports of three processes, on a machine that is busy."""

    def slowly():
        time.sleep(0.5)  # it asks Slurm, which takes processor time
        return condition()

    wait_for(slowly, 3600)


@pytest.mark.slow
def test_a_task_is_cancelled_and_the_same_command_goes_on(
    real_slurm, undisturbed, command, tmp_path
):
    path = write_suite(tmp_path, LONG, 'agent = ["equivariant", "zero"]')
    out = tmp_path / "runs"
    file = launcher(tmp_path, 'cpus = 1\nmemory = "1500M"')
    words = ("sweep", path, "--runs", out, "--launcher", file)
    code, shown = command(*words)
    assert (code, shown.err) == (0, "")
    first, second = make_plan(load_suite(path), out).runs
    job = jobs_of(out)[first.run_id]
    # At first none of them runs.
    assert sum(state_in(out, "tiny").values()) == 2
    assert "2 in the queue before, 0 queued now" in command(*words)[1].out
    wait_long((out / first.run_id / CHECKPOINT).is_file)
    assert state_in(out, "tiny")["running"] >= 1
    told("scancel", job)
    wait_long(lambda: job not in told("squeue", "-h", "-r", "-o", "%i").split())
    wait_long(lambda: is_finished(out / second.run_id))
    assert state_in(out, "tiny") == {"running": 0, "queued": 0, "lost": 1}
    assert (
        f"(output: {out / 'sweeps' / 'tiny-slurm' / job}_0_log.out)"
        in command("status", out)[1].out
    )
    assert "1 runs finished, 0 in the queue before, 1 queued now" in command(*words)[1].out
    wait_long(lambda: is_finished(out / first.run_id))
    assert read_record(out / first.run_id / RECORD).wall_clock.resumed == 1
    assert without_clock(out / first.run_id) == without_clock(undisturbed)
    assert "0 in the queue before, 0 queued now" in command(*words)[1].out
    # Both tasks needed the same base policy: one has made it.
    assert len(list((out / "base").glob("*/policy.safetensors"))) == 1


@pytest.mark.slow
def test_time_ends_others_come_first_and_a_node_goes_down(real_slurm, command, tmp_path):
    """Slurm queues the task again each time, and the record is that of an undisturbed run."""
    path = write_suite(tmp_path, LONGER, 'agent = ["equivariant"]')
    out = tmp_path / "runs"
    file = launcher(tmp_path, 'cpus = 1\nmemory = "1500M"\ntime = "60"')
    assert command("sweep", path, "--runs", out, "--launcher", file)[0] == 0
    [run] = make_plan(load_suite(path), out).runs
    folder, job = out / run.run_id, jobs_of(out)[run.run_id]

    def restarts():
        return int(re.search(r"Restarts=(\d+)", told("scontrol", "show", "job", job))[1])

    def time_ends():
        """The warning comes between 150 and 120 seconds before the end."""
        minutes = int(told("squeue", "-h", "-j", job, "-o", "%M").split(":")[-2])
        told("scontrol", "update", f"JobId={job}", f"TimeLimit={minutes + 3}")
        wait_long(lambda: restarts() == 1)
        told("scontrol", "update", f"JobId={job}", "TimeLimit=60")

    def others_come_first():
        told(
            "sbatch", "--partition=first", "--cpus-per-task=2", "--wrap=true", "--output=/dev/null"
        )
        wait_long(lambda: restarts() == 2)

    def node_goes_down():
        told("scontrol", "update", f"NodeName={real_slurm}", "State=DOWN", "Reason=test")
        wait_long(lambda: restarts() == 3)

    saved = 0
    for event in (time_ends, others_come_first, node_goes_down):
        wait_long((folder / CHECKPOINT).is_file)
        wait_long(lambda: (folder / CHECKPOINT).stat().st_mtime_ns > saved)  # noqa: B023
        event()
        wait_long(lambda: state_in(out, "tiny")["queued"] == 1)
        saved = (folder / CHECKPOINT).stat().st_mtime_ns
    told("scontrol", "update", f"NodeName={real_slurm}", "State=RESUME")
    alone = execute(LONGER, tmp_path / "alone")
    wait_long(lambda: is_finished(folder))
    assert read_record(folder / RECORD).wall_clock.resumed == 3
    assert without_clock(folder) == without_clock(alone)
