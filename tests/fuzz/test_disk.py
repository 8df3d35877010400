"""Full disks and read-only folders: one sentence, nothing lost, and the run can go on."""

from __future__ import annotations

import contextlib
import errno
import io
import os
import pty
import resource
import shutil
import signal
import subprocess
import sys
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest

from symsteer import cli
from symsteer.bench.demos import load
from symsteer.bench.runs.checkpoint import load_checkpoint
from symsteer.bench.runs.film import write_video
from symsteer.bench.runs.folder import state_of
from symsteer.bench.runs.run import execute, resume
from symsteer.bench.runs.trainer import Trainer
from symsteer.errors import UserError
from symsteer.leaderboard.records import dump_record, read_record
from tests.bench.tiny_run import without_clock
from tests.fuzz.conftest import CONFIG, options_of
from tests.fuzz.judge import CURE, one_sentence
from tests.leaderboard.record_factory import make_record

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


@contextlib.contextmanager
def no_space_in(folder):
    """Fill the file system that ``folder`` lies on, to the last byte."""
    ballast = folder / "ballast"
    with open(ballast, "wb", buffering=0) as file, contextlib.suppress(OSError):
        for size in (2**16, 2**10, 1):
            with contextlib.suppress(OSError):
                while True:
                    file.write(bytes(size))
    try:
        yield
    finally:
        ballast.unlink()


@pytest.fixture
def small_disk(tmp_path):
    """A file system of its own, of a few megabytes."""
    place = tmp_path / "disk"
    place.mkdir()
    made = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", str(place)],
        capture_output=True,
        check=False,
    )
    if made.returncode:
        pytest.skip("no file system can be mounted here")
    yield place
    subprocess.run(["umount", "--lazy", str(place)], check=True)


@pytest.fixture
def read_only(tmp_path):
    """Make a folder read-only, also for root; gives a function."""
    mounted, changed = [], []

    def lock(folder):
        if os.geteuid():
            folder.chmod(0o555)
            changed.append(folder)
            return folder
        for options in (["--bind"], ["-o", "remount,bind,ro"]):
            command = ["mount", *options, str(folder), str(folder)]
            if subprocess.run(command, capture_output=True, check=False).returncode:
                pytest.skip("root can write everywhere, and nothing can be mounted here")
            if options == ["--bind"]:
                mounted.append(folder)
        return folder

    yield lock
    for folder in mounted:
        subprocess.run(["umount", str(folder)], check=True)
    for folder in changed:
        folder.chmod(0o755)


# What is watched.


@pytest.fixture(scope="module")
def undisturbed(workshop, tmp_path_factory):
    """A run without errors; its demonstrations and base policy are in the same folder."""
    out = tmp_path_factory.mktemp("undisturbed")
    shutil.copytree(workshop.base, out / "base")
    return execute(SHORT, out, progress=False)


def called(*arguments):
    """Exit code and lines on stderr."""
    out, err = io.StringIO(), io.StringIO()
    with (
        patch.object(sys, "argv", ["symsteer", *map(str, arguments)]),
        contextlib.redirect_stdout(out),
        contextlib.redirect_stderr(err),
    ):
        code = cli.main()
    return code, err.getvalue().splitlines()


def complaint(*arguments):
    """The sentence of a command that must fail, and what follows it."""
    code, lines = called(*arguments)
    assert code == 2, lines
    return one_sentence(lines[0]), lines[1:]


def leftovers(folder):
    """Files that only a write that failed can have left."""
    return [p.name for p in folder.rglob("*") if p.name.endswith((".tmp", ".partial", ".part"))]


def full_after_the_first_checkpoint(full):
    """A patch: the disk is full from the first checkpoint on, until the stack is closed."""
    whole = Trainer._checkpoint
    stack = contextlib.ExitStack()

    def save(trainer):
        whole(trainer)
        stack.enter_context(full())

    stack.enter_context(patch.object(Trainer, "_checkpoint", save))
    return stack


def run_into(full, undisturbed, out):
    """Start a run whose disk gets full; it keeps its last checkpoint, and continues to the end."""
    shutil.copytree(undisturbed.parent / "base", out / "base")
    folder = out / undisturbed.name
    with full_after_the_first_checkpoint(full):
        sentence, notes = complaint("run", "--quiet", *options_of(SHORT), "--out", out)
    assert str(folder) in sentence
    assert any(word in sentence for word in ("File too large", "No space left on device"))
    assert CURE.search(sentence)
    assert notes == [f"continue the run with: symsteer resume {folder}"]
    assert not leftovers(folder)
    assert state_of(folder) in ("interrupted", "failed")
    state = load_checkpoint(folder)
    assert state["env_steps"] == 80
    assert len(read_record(folder / "record.json").evaluations) >= state["evaluations"]
    resume(folder, progress=False)
    assert without_clock(folder) == without_clock(undisturbed)
    assert read_record(folder / "record.json").wall_clock.resumed == 1
    assert not leftovers(folder)


# Runs.


@pytest.mark.slow
@pytest.mark.parametrize(
    "size", [pytest.param(0, id="every file"), pytest.param(25_000, id="large ones")]
)
def test_a_run_outlives_a_full_disk(size, undisturbed, tmp_path):
    run_into(lambda: files_end_at(size), undisturbed, tmp_path)


@pytest.mark.slow
def test_a_run_outlives_a_disk_that_is_really_full(undisturbed, small_disk):
    run_into(lambda: no_space_in(small_disk), undisturbed, small_disk)


def test_a_disk_that_is_full_from_the_beginning(undisturbed, tmp_path):
    with files_end_at(0):
        sentence, _ = complaint("run", "--quiet", *options_of(SHORT), "--out", tmp_path / "runs")
    assert "config.json" in sentence
    assert [p for p in (tmp_path / "runs").rglob("*") if p.is_file()] == []


@pytest.mark.parametrize(
    ("kept", "size", "blamed"),
    [("nothing", 10_000, ".h5"), ("demonstrations", 10_000, "policy.safetensors")],
)
def test_demonstrations_and_base_policies_appear_whole(kept, size, blamed, undisturbed, tmp_path):
    base = tmp_path / "base"
    base.mkdir()
    if kept == "demonstrations":
        for path in (undisturbed.parent / "base").glob("*.*"):
            shutil.copy(path, base)
    before = sorted(p for p in base.rglob("*") if p.is_file())
    with files_end_at(size):
        sentence, _ = complaint("run", "--quiet", *options_of(SHORT), "--out", tmp_path)
    assert blamed in sentence
    assert sorted(p for p in base.rglob("*") if p.is_file()) == before
    assert not (tmp_path / undisturbed.name).exists()


def test_a_run_outlives_its_terminal(undisturbed, tmp_path):
    shutil.copytree(undisturbed.parent / "base", tmp_path / "base")
    ours, theirs = pty.openpty()
    words = [sys.executable, "-m", "symsteer", "run", *options_of(SHORT), "--out", str(tmp_path)]
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


def test_earlier_demonstrations_survive(tmp_path):
    path = tmp_path / "a.h5"
    arguments = ("demos", path, "--task", "PushCube-v1", "--mode", "clean", "--count")
    assert called(*arguments, 1)[0] == 0
    found = load(path, "PushCube-v1", "floating")
    for size in (0, 3_000):
        with files_end_at(size):
            sentence, _ = complaint(*arguments, 2)
        assert "a.h5" in sentence or "a.json" in sentence
    assert load(path, "PushCube-v1", "floating").content_hash == found.content_hash
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.h5", "a.json"]


def test_the_bookkeeping_of_a_sweep(tmp_path):
    with files_end_at(10):
        sentence, _ = complaint("sweep", "smoke", "--out", tmp_path, "--workers", 1)
    assert str(tmp_path / "sweeps") in sentence
    assert not leftovers(tmp_path)
    assert not list(tmp_path.rglob("record.json"))


def test_an_earlier_leaderboard_survives(workshop, tmp_path):
    results, board = tmp_path / "results", tmp_path / "board"
    results.mkdir()
    for name in ("a", "b"):
        (results / f"{name}.json").write_text(workshop.records[name])
    assert called("report", results / "a.json", "--out", board)[0] == 0
    before = {p: p.read_bytes() for p in board.rglob("*") if p.is_file()}
    with files_end_at(3_000):
        sentence, _ = complaint("report", results, "--out", board)
    assert str(board) in sentence
    assert {p: p.read_bytes() for p in board.rglob("*") if p.is_file()} == before


SMALL_AUDIT = ("--states", "expert", "--count", 8, "--resets", 16, "--group", "C2")

PAIR = ("standard", "equivariant")

WRITERS = {
    "film": ("film", "RUN", "--episodes", 1, "--out", "OUT/a.gif"),
    "bundle": ("export", "RUN", "--contents", "demonstrations", "--out", "OUT/a.zip"),
    "lerobot": ("export", "RUN", "--format", "lerobot", "--videos", "off", "--out", "OUT/set"),
    "audit": ("audit", "--task", "PushCube-v1", *SMALL_AUDIT, "--out", "OUT"),
    "report": ("report", "RESULTS", "--out", "OUT"),
    "site": ("site", "RESULTS", "--no-docs", "--out", "OUT"),
    "compare": (
        "compare",
        "standard",
        "equivariant",
        "--runs",
        "RESULTS",
        "--picture",
        "OUT/a.png",
    ),
    "new": ("new", "agent", "mine", "--out", "OUT"),
}


@pytest.mark.parametrize("verb", WRITERS)
def test_what_a_verb_writes_is_whole_or_not_there(verb, undisturbed, tmp_path):
    """A full disk, and a file in the place of the folder; what was written before stays."""
    results = tmp_path / "results"
    results.mkdir()
    for agent in PAIR:
        (results / f"{agent}.json").write_text(dump_record(make_record(agent=agent)))

    def arguments(out):
        places = {"RUN": str(undisturbed), "RESULTS": str(results), "OUT": str(out)}
        return [places.get(str(w), str(w).replace("OUT/", f"{out}/")) for w in WRITERS[verb]]

    out = tmp_path / "out"
    with files_end_at(200):
        sentence, _ = complaint(*arguments(out))
    assert str(out) in sentence
    assert [p for p in tmp_path.rglob("*") if p.is_file() and p.parent != results] == []
    code, lines = called(*arguments(out))
    assert code in (0, 1), lines
    before = {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}
    assert before
    if verb not in ("lerobot", "new"):
        with files_end_at(200):
            complaint(*arguments(out))
    assert {p: p.read_bytes() for p in out.rglob("*") if p.is_file()} == before
    (tmp_path / "file").write_text("in the way")
    sentence, _ = complaint(*arguments(tmp_path / "file" / "out"))
    assert str(tmp_path / "file") in sentence
    assert not leftovers(tmp_path)


def test_a_video_is_whole_or_not_there(tmp_path):
    """imageio does not tell of an encoder that fails."""
    frames = np.random.default_rng(0).integers(0, 255, (30, 64, 64, 3), dtype=np.uint8)
    path = tmp_path / "new" / "a.mp4"
    for size in (0, 20_000):
        with (
            files_end_at(size),
            pytest.raises(UserError, match=f"{path} cannot be written: "),
        ):
            write_video(path, iter(frames))
    write_video(path, iter(frames))
    before = path.read_bytes()
    with files_end_at(20_000), pytest.raises(UserError, match="cannot be written"):
        write_video(path, iter(frames))
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == ["a.mp4"]


def test_read_only_folders(undisturbed, workshop, read_only, tmp_path):
    """Writing fails; commands that only read still work."""
    runs = tmp_path / "runs"
    shutil.copytree(undisturbed.parent, runs)
    stopped = workshop.restore_run(runs)
    finished = runs / undisturbed.name
    read_only(runs)
    for arguments in (
        ("run", "--quiet", "--seed", 5, *options_of(SHORT), "--out", runs),
        ("resume", stopped),
        ("sweep", "smoke", "--out", runs),
        ("demos", runs / "a.h5", "--count", 1),
        ("report", finished, "--out", runs / "board"),
        ("audit", "--out", runs / "audit"),
        ("film", finished, "--episodes", 1),
        ("export", finished, "--out", runs / "a.zip"),
        ("export", finished, "--format", "lerobot", "--out", runs / "set"),
        ("site", finished, "--no-docs", "--out", runs / "site"),
        ("new", "agent", "mine", "--out", runs),
    ):
        sentence, _ = complaint(*arguments)
        assert str(runs) in sentence
        reasons = (os.strerror(errno.EROFS), os.strerror(errno.EACCES), "cannot be written to")
        assert any(reason in sentence for reason in reasons)
    assert called("status", runs)[0] == 0
    assert called("report", finished, "--out", tmp_path / "board")[0] == 0
    assert called("evaluate", finished)[0] == 0
