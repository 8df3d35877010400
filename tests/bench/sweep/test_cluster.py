"""The runs of a sweep on a Ray cluster of two machines, one of which dies."""

import os
import shutil
import socket
import subprocess
import sys
import threading

import psutil
import pytest

from symsteer.bench.runs.folder import CHECKPOINT, LOCK
from symsteer.bench.sweep import cluster as cluster_module
from symsteer.bench.sweep.cluster import RayCluster
from symsteer.bench.sweep.command import run_plan
from symsteer.bench.sweep.plan import make_plan
from symsteer.bench.sweep.suite import Suite
from symsteer.bench.sweep.workforce import Workforce
from symsteer.errors import UserError
from symsteer.leaderboard.records import read_record
from tests.bench.sweep.long_run import LONG, wait_for
from tests.bench.tiny_run import execute, tiny_config, without_clock
from tests.marks import need

MACHINE = {"num_cpus": 1, "object_store_memory": 80 * 2**20}


def test_without_ray_the_extra_is_named(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(UserError, match=r'pip install "symsteer\[ray\]"'):
        RayCluster("auto", tmp_path, None)


def test_an_address_that_does_not_answer(monkeypatch, tmp_path):
    need("ray")
    monkeypatch.setattr(cluster_module, "CONNECT_SECONDS", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(UserError, match=f"no Ray cluster answers at {address}"):
            RayCluster(address, tmp_path, None)


@pytest.fixture(scope="module")
def cluster():
    """A head without processors and two machines with one each, all on this one."""
    need("ray")
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    # Ray's workers give way to all other processes, so that beside other tests they stand still.
    os.environ["RAY_worker_niceness"] = "0"  # noqa: SIM112 (the name that Ray reads)
    from ray.cluster_utils import Cluster

    cluster = Cluster(
        initialize_head=True,
        head_node_args={**MACHINE, "num_cpus": 0, "include_dashboard": False},
    )
    for _ in range(2):
        cluster.add_node(**MACHINE)
    yield cluster
    cluster.shutdown()


def machine_of(run, machines):
    """The machine whose process holds a run, or None."""
    raylets = {machine.all_processes["raylet"][0].process.pid: machine for machine in machines}
    for pid, machine in raylets.items():
        for process in psutil.Process(pid).children(recursive=True):
            if str(run / LOCK) in (file.path for file in process.open_files()):
                return machine
    return None


@pytest.mark.slow
def test_machines_do_not_import_from_the_current_folder(cluster, tmp_path, monkeypatch):
    canary = tmp_path / "canary"
    monkeypatch.chdir(tmp_path)
    for name in ("grpc", "torch", "numpy"):
        (tmp_path / f"{name}.py").write_text(f"open({str(canary)!r}, 'w')")
    RayCluster(cluster.address, tmp_path, None).stop()  # has asked every machine
    assert not canary.exists()


@pytest.mark.slow
def test_a_folder_that_is_not_shared_is_refused(cluster, tmp_path):
    """The sweep alone sees a file system of its own where the runs are to lie."""
    own = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c"]
    if shutil.which("unshare") is None or subprocess.run([*own, "true"], check=False).returncode:
        pytest.skip("this machine allows no mount namespaces")
    out = tmp_path / "runs"
    out.mkdir()
    sweep = f"{sys.executable} -m symsteer sweep smoke --runs {out} --ray {cluster.address}"
    done = subprocess.run(
        [*own, f"mount -t tmpfs tmpfs {out} && exec {sweep}"],
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
    )
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: the folder {out} is not shared: ")
    assert done.stderr.count("\n") == 1
    assert done.stdout == ""


@pytest.mark.slow
def test_a_machine_dies_and_nothing_is_lost(cluster, undisturbed, tmp_path, capsys):
    out = tmp_path / "runs"
    other = tiny_config(agent="zero")
    plan = make_plan(Suite("two", "", (LONG, other)), out, elsewhere=True)
    run = out / plan.runs[0].run_id

    def kill() -> None:
        # To look for its process takes long; before that, there are demonstrations and a policy.
        wait_for((run / LOCK).is_file)
        wait_for(lambda: machine_of(run, cluster.worker_nodes))
        machine = machine_of(run, cluster.worker_nodes)
        raylet = psutil.Process(machine.all_processes["raylet"][0].process.pid)
        victims = [raylet, *raylet.children(recursive=True)]
        wait_for((run / CHECKPOINT).is_file)
        # As when its power fails: all at once, the one first that would tell of the others.
        for process in victims:
            process.kill()
        cluster.remove_node(machine, allow_graceful=False)

    killer = threading.Thread(target=kill)
    killer.start()
    ends = run_plan(plan, Workforce(ray=cluster.address))
    killer.join()
    assert len(cluster.worker_nodes) == 1
    assert [end.status for end in ends] == ["finished", "finished"]
    assert capsys.readouterr().out.count("finished  [") == 2
    assert read_record(run / "record.json").wall_clock.resumed == 1
    assert without_clock(run) == without_clock(undisturbed)
    alone = execute(other, undisturbed.parent)
    assert without_clock(out / alone.name) == without_clock(alone)
