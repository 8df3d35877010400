"""Hostile paths: one sentence, exit code 2, and nothing written."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from symsteer.leaderboard.paths import record_files
from symsteer.leaderboard.records import write_record
from symsteer.leaderboard.records.files import MAX_BYTES
from symsteer.leaderboard.report import generate
from tests.leaderboard.command_line import main
from tests.leaderboard.record_factory import make_record, snapshot


@pytest.fixture
def good(tmp_path: Path) -> Path:
    record = make_record(agent="base")
    write_record(record, tmp_path / "good" / f"{record.run_id}.json")
    return tmp_path / "good"


def refused(capsys: pytest.CaptureFixture[str], *arguments: object) -> str:
    """The one sentence with which the command refuses."""
    assert main([str(argument) for argument in arguments]) == 2
    shown = capsys.readouterr()
    assert shown.out == ""
    assert shown.err.startswith("error: ")
    assert shown.err.count("\n") == 1
    return shown.err


def test_run_folders_hold_other_json_and_committed_records_none(good: Path, tmp_path: Path) -> None:
    run = tmp_path / "runs" / "a-run"
    write_record(make_record(), run / "record.json")
    (run / "config.json").write_text("{}")
    (tmp_path / "runs" / "base").mkdir()
    (tmp_path / "runs" / "base" / "demonstrations.json").write_text('{"episodes": []}')
    assert record_files([tmp_path / "runs"]) == [run / "record.json"]
    # A run folder laid among committed records does not hide them.
    shutil.copytree(run, good / "a-run")
    assert [path.name for path in record_files([good])] == ["record.json", "run-none-base-0.json"]


def test_each_file_counts_once(good: Path, tmp_path: Path) -> None:
    (file,) = good.iterdir()
    (tmp_path / "link.json").symlink_to(file)
    (tmp_path / "folder").symlink_to(good)
    paths = [good, file, tmp_path / "link.json", tmp_path / "folder", good / ".." / "good"]
    assert record_files(paths) == [file]
    # Links to folders inside of one are not followed.
    (good / "loop").symlink_to(good)
    (good / "root").symlink_to("/")
    assert record_files([good]) == [file]


def test_paths_that_are_no_records(
    good: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "loop.json").symlink_to(tmp_path / "loop.json")
    os.mkfifo(tmp_path / "pipe.json")
    (tmp_path / "empty").mkdir()
    with open(tmp_path / "huge.json", "wb") as file:
        file.truncate(MAX_BYTES + 1)
    cases = {
        tmp_path / "nowhere": "does not exist",
        tmp_path / "loop.json": "cannot be read",
        tmp_path / "pipe.json": "no ordinary file",
        tmp_path / ("x" * 5000): "cannot be read",
        tmp_path / "empty": "holds no record",
        tmp_path / "huge.json": "larger than 64 MiB",
        next(good.iterdir()) / "below": "cannot be read",
    }
    for path, words in cases.items():
        for verb in (["--verify"], ["--out", tmp_path / "out"]):
            assert words in refused(capsys, path, *verb)
    assert not (tmp_path / "out").exists()
    # In a folder.
    (good / "broken.json").symlink_to(tmp_path / "gone")
    assert "broken.json" in refused(capsys, good, "--out", tmp_path / "out")
    (good / "broken.json").unlink()
    os.mkfifo(good / "pipe.json")
    assert "pipe.json" in refused(capsys, good, "--out", tmp_path / "out")
    # Beside a run folder it is not taken for a record.
    write_record(make_record(), good / "run" / "record.json")
    assert len(record_files([good])) == 2


def test_a_name_that_is_no_text(
    good: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    strange = good / os.fsdecode(b"caf\xe9.json")
    next(good.iterdir()).rename(strange)
    assert "not UTF-8: rename it" in refused(capsys, good, "--out", tmp_path / "out")
    strange.rename(good / "caf\u00e9 [x](y).json")
    out = tmp_path / os.fsdecode(b"out\xe9")
    generate([good], out)
    assert "](../good/caf%C3%A9%20%5Bx%5D%28y%29.json)" in (out / "LEADERBOARD.md").read_text()


# Where it is written


def test_what_cannot_be_written_leaves_the_rest_alone(
    good: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Files that are links are replaced, not written through; bad records change nothing."""
    (tmp_path / "file").write_text("mine")
    out = tmp_path / "out"
    out.mkdir()
    (out / "leaderboard.csv").symlink_to(tmp_path / "file")
    generate([good], out)
    assert not (out / "leaderboard.csv").is_symlink()
    refused(capsys, good, "--out", tmp_path / "file")
    assert (tmp_path / "file").read_text() == "mine"
    before = snapshot(out)
    (good / "another.json").write_text("{")
    for folder in (out, tmp_path / "fresh"):
        assert "another.json is not strict JSON" in refused(capsys, good, "--out", folder)
    assert snapshot(out) == before
    assert not (tmp_path / "fresh").exists()


def test_figures_are_not_written_through_a_link(
    good: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, elsewhere = tmp_path / "out", tmp_path / "elsewhere"
    out.mkdir()
    elsewhere.mkdir()
    (out / "figures").symlink_to(elsewhere)
    assert "figures is a link" in refused(capsys, good, "--out", out)
    assert list(elsewhere.iterdir()) == []
    # The folder itself may be one.
    (tmp_path / "linked").symlink_to(elsewhere)
    assert main([str(good), "--out", str(tmp_path / "linked")]) == 0
    assert (elsewhere / "LEADERBOARD.md").exists()
