"""Full disks and read-only folders: one sentence, nothing lost, and the run can go on."""

from __future__ import annotations

import contextlib
import errno
import os
import pty
import resource
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from unittest.mock import patch

import pytest

from symsteer.bench.runs.checkpoint import load_checkpoint
from symsteer.bench.runs.folder import state_of
from symsteer.bench.runs.trainer import Trainer
from symsteer.extras import EXTRAS
from symsteer.leaderboard.records import dump_record, read_record
from tests.bench.tiny_run import execute, resume, without_clock
from tests.fuzz.conftest import CONFIG
from tests.fuzz.judge import end_of
from tests.fuzz.kinds import options_of
from tests.leaderboard.record_factory import make_record
from tests.marks import need

pytestmark = pytest.mark.long

SHORT = replace(CONFIG, env_steps=160)
"""A run with one checkpoint on the way and one at the end."""


# Making a disk full.


@contextlib.contextmanager
def files_end_at(size):
    """Let no file of this process grow beyond ``size`` bytes.

    Writing then fails with EFBIG ("File too large"); a full disk gives ENOSPC. Python handles both
    in the same way, and this one needs no permissions.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


@pytest.fixture
def read_only():
    """Make a folder read-only, also for root; gives a function."""
    with contextlib.ExitStack() as undo:

        def lock(folder):
            if os.geteuid():
                folder.chmod(0o555)
                undo.callback(folder.chmod, 0o755)
                return
            for options in (["--bind"], ["-o", "remount,bind,ro"]):
                command = ["mount", *options, str(folder), str(folder)]
                if subprocess.run(command, capture_output=True, check=False).returncode:
                    pytest.skip("root can write everywhere, and nothing can be mounted here")
                if options == ["--bind"]:
                    undo.callback(subprocess.run, ["umount", str(folder)], check=True)

        yield lock


# What is watched.


@pytest.fixture(scope="module")
def undisturbed(workshop, tmp_path_factory):
    """A run without errors; its demonstrations and base policy are in the same folder."""
    out = tmp_path_factory.mktemp("undisturbed")
    shutil.copytree(workshop.run.parent / "base", out / "base")
    return execute(SHORT, out)


def complaint(*arguments):
    """The sentence of a command that must fail."""
    ending = end_of(arguments, notes=True)
    assert ending.kind == "refused", ending
    return ending.sentence


def files_in(folder):
    """Paths and contents; locks are empty, and stay for the next who builds."""
    files = (path for path in folder.rglob("*") if path.is_file() and path.suffix != ".lock")
    return {path: path.read_bytes() for path in files}


def leftovers(folder):
    """Files that only a write that failed can have left."""
    return [p.name for p in folder.rglob("*") if p.name.endswith((".tmp", ".partial", ".part"))]


# Runs.


@pytest.mark.slow
@pytest.mark.parametrize(
    "size", [pytest.param(0, id="every file"), pytest.param(25_000, id="large ones")]
)
def test_a_run_outlives_a_full_disk(size, undisturbed, tmp_path):
    """It keeps its last checkpoint, and continues to the end."""
    shutil.copytree(undisturbed.parent / "base", tmp_path / "base")
    folder = tmp_path / undisturbed.name
    whole = Trainer._checkpoint
    with contextlib.ExitStack() as stack:

        def save(trainer):
            whole(trainer)
            stack.enter_context(files_end_at(size))

        stack.enter_context(patch.object(Trainer, "_checkpoint", save))
        ending = end_of(["run", "--quiet", *options_of(SHORT), "--runs", tmp_path], notes=True)
    assert str(folder) in ending.sentence
    assert os.strerror(errno.EFBIG) in ending.sentence
    assert ending.notes == [f"continue the run with: symsteer resume {folder}"]
    assert not leftovers(folder)
    assert state_of(folder) in ("interrupted", "failed")
    state = load_checkpoint(folder)
    assert state["env_steps"] == 80
    assert len(read_record(folder / "record.json").evaluations) >= state["evaluations"]
    resume(folder)
    assert without_clock(folder) == without_clock(undisturbed)
    assert read_record(folder / "record.json").wall_clock.resumed == 1
    assert not leftovers(folder)


@pytest.mark.parametrize(
    ("kept", "size", "blamed"),
    [
        ("", 0, "config.json"),
        ("", 10_000, ".h5"),
        ("*.*", 10_000, "policy.safetensors"),
    ],
)
def test_what_a_run_begins_with_appears_whole(kept, size, blamed, undisturbed, tmp_path):
    """Configuration, demonstrations, base policy; what was there stays."""
    (tmp_path / "base").mkdir()
    for path in (undisturbed.parent / "base").glob(kept) if kept else ():
        shutil.copy(path, tmp_path / "base")
    before = files_in(tmp_path)
    with files_end_at(size):
        sentence = complaint("run", "--quiet", *options_of(SHORT), "--runs", tmp_path)
    assert blamed in sentence
    assert files_in(tmp_path) == before


def test_a_run_outlives_its_terminal(undisturbed, tmp_path):
    shutil.copytree(undisturbed.parent / "base", tmp_path / "base")
    ours, theirs = pty.openpty()
    words = [sys.executable, "-m", "symsteer", "run", *options_of(SHORT), "--runs", str(tmp_path)]
    hangup = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        streams = {"stdin": theirs, "stdout": theirs, "stderr": theirs}
        process = subprocess.Popen(words, **streams, start_new_session=True)
    finally:
        signal.signal(signal.SIGHUP, hangup)
    os.close(theirs)
    os.read(ours, 1)  # the first sign of progress
    os.close(ours)
    assert process.wait(300) == 0
    assert without_clock(tmp_path / undisturbed.name) == without_clock(undisturbed)


# The other verbs.


def test_the_bookkeeping_of_a_sweep(tmp_path):
    with files_end_at(10):
        sentence = complaint("sweep", "smoke", "--runs", tmp_path, "--workers", 1)
    assert str(tmp_path / "sweeps") in sentence
    assert not leftovers(tmp_path)
    assert not list(tmp_path.rglob("record.json"))


PAIR = ("standard", "equivariant")

WRITERS = {
    "film": ("film", "RUN", "--episodes", 1, "--out", "OUT/a.mp4"),
    "bundle": ("export", "RUN", "--out", "OUT/a.zip"),
    "lerobot": ("export-lerobot", "DEMOS", "--videos", "off", "--out", "OUT/set"),
    "audit": ("audit", "--base-policy", "none", "--states", 8, "--group", "C2", "--out", "OUT"),
    "report": ("report", "RESULTS", "--out", "OUT"),
    "site": ("site", "RESULTS", "--no-docs", "--out", "OUT"),
    "compare": ("compare", *PAIR, "--runs", "RESULTS", "--picture", "OUT/a.png"),
    "demos": ("demos", "OUT/a.h5", "--task", "PushCube-v1", "--mode", "clean", "--count", 1),
    "new": ("new", "agent", "mine", "--out", "OUT"),
}


@pytest.fixture
def line(undisturbed, tmp_path):
    """The command line of a verb that writes into a folder."""
    results = tmp_path / "results"
    results.mkdir()
    for agent in PAIR:
        (results / f"{agent}.json").write_text(dump_record(make_record(agent=agent)))
    demos = next(undisturbed.parent.glob("base/*.h5"))

    def arguments(verb, out):
        places = {"RUN": undisturbed, "DEMOS": demos, "RESULTS": results, "OUT": out}
        return [str(places.get(w, str(w).replace("OUT/", f"{out}/"))) for w in WRITERS[verb]]

    return arguments


@pytest.mark.parametrize("verb", WRITERS)
def test_what_a_verb_writes_is_whole_or_not_there(verb, line, tmp_path):
    """A full disk, and a file in the place of the folder; what was written before stays."""
    if verb in EXTRAS:
        need(verb)
    out, before = tmp_path / "out", files_in(tmp_path)
    with files_end_at(200):
        assert str(out) in complaint(*line(verb, out))
    assert files_in(tmp_path) == before
    assert end_of(line(verb, out)).kind == "done"
    before = files_in(tmp_path)
    assert files_in(out)
    if verb not in ("audit", "lerobot", "new"):
        with files_end_at(200):
            complaint(*line(verb, out))
    assert files_in(tmp_path) == before
    (tmp_path / "file").write_text("in the way")
    assert str(tmp_path / "file") in complaint(*line(verb, tmp_path / "file" / "out"))
    assert not leftovers(tmp_path)


def test_read_only_folders(undisturbed, workshop, line, read_only, tmp_path):
    """Writing fails; commands that only read still work."""
    runs = tmp_path / "runs"
    shutil.copytree(undisturbed.parent, runs)
    stopped, finished = workshop.restore_run(runs), runs / undisturbed.name
    read_only(runs)
    for arguments in (
        ("run", "--quiet", "--seed", 5, *options_of(SHORT), "--runs", runs),
        ("resume", stopped),
        ("sweep", "smoke", "--runs", runs),
        *(line(verb, runs / "new") for verb in WRITERS),
    ):
        sentence = complaint(*arguments)
        assert str(runs) in sentence
        reasons = (os.strerror(errno.EROFS), os.strerror(errno.EACCES), "cannot be written to")
        assert any(reason in sentence for reason in reasons)
    for arguments in (
        ("status", runs),
        ("report", finished, "--out", tmp_path / "board"),
        ("evaluate", finished),
    ):
        assert end_of(arguments).kind == "done"
