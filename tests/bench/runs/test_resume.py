"""A run that is killed and continued ends with the record of an undisturbed one."""

import json
import multiprocessing
import os
import random
import shutil
import signal
import time
from dataclasses import replace

import pytest
import torch

from bench.runs.folder import state_of
from bench.runs.run import execute, resume
from leaderboard.records import read_record
from tests.bench.tiny_run import tiny_config

# Fresh processes that have their imports done: a kill then falls into the run, not into these.
PROCESSES = multiprocessing.get_context("forkserver")
PROCESSES.set_forkserver_preload(["tests.bench.runs.test_resume", "torch._dynamo"])

CONFIG = replace(tiny_config(env_steps=960), checkpoint_every=60)


def _work(folder):
    torch.set_num_threads(1)
    resume(folder, progress=False)


def start(folder):
    process = PROCESSES.Process(target=_work, args=(folder,), daemon=True)
    process.start()
    return process


def without_clock(folder):
    data = json.loads((folder / "record.json").read_text())
    # Nor the checkout, which a developer may change while the tests run.
    for key in ("started", "ended", "wall_clock", "provenance", "continued"):
        del data[key]
    del data["base_policy"]["training_seconds"]
    for evaluation in data["evaluations"]:
        del evaluation["wall_clock"]
    return data


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory):
    return execute(CONFIG, tmp_path_factory.mktemp("undisturbed"), progress=False)


@pytest.fixture
def begun(undisturbed, tmp_path):
    """The folder of a run that was stopped before it had done anything."""
    shutil.copytree(undisturbed.parent / "base", tmp_path / "base")
    folder = tmp_path / undisturbed.name
    folder.mkdir()
    shutil.copy(undisturbed / "config.json", folder)
    return folder


def duration(folder):
    start_time = time.monotonic()
    process = start(folder)
    process.join()
    assert process.exitcode == 0
    return time.monotonic() - start_time


def kill_after(folder, seconds):
    """Run in a process of its own and kill it; whether it was still at work then."""
    process = start(folder)
    process.join(seconds)
    alive = process.is_alive()
    os.kill(process.pid, signal.SIGKILL) if alive else None
    process.join()
    return alive


def _killed_anywhere(undisturbed, begun, kills, seed):
    """Kill ``kills`` runs at random moments each, continue them; how many checkpoints were used."""
    generator = random.Random(seed)
    pristine = begun.parent.parent / "pristine"
    shutil.copytree(begun, pristine)
    whole = duration(begun)
    assert without_clock(begun) == without_clock(undisturbed)
    resumed = []
    for _ in range(kills):
        moment = generator.uniform(0, whole)
        shutil.rmtree(begun)
        shutil.copytree(pristine, begun)
        if kill_after(begun, moment):
            assert state_of(begun) == "interrupted"
            resume(begun, progress=False)
        assert state_of(begun) == "finished"
        assert without_clock(begun) == without_clock(undisturbed), f"killed after {moment:.2f} s"
        resumed.append(read_record(begun / "record.json").wall_clock.resumed)
    return resumed


def test_killed_at_a_random_moment(undisturbed, begun):
    _killed_anywhere(undisturbed, begun, kills=2, seed=0)


@pytest.mark.slow
def test_killed_at_twenty_random_moments(undisturbed, begun):
    resumed = _killed_anywhere(undisturbed, begun, kills=20, seed=1)
    # Some fall before the first checkpoint, some behind it.
    assert 5 <= sum(resumed) <= 20
    print(f"{sum(resumed)} of 20 continued from a checkpoint, the others from the beginning")
