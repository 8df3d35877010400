"""`--verify`: every byte of the leaderboard comes from its records, on any machine."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from symsteer.leaderboard.records import write_record
from symsteer.leaderboard.report import generate, slug
from symsteer.leaderboard.verification import differences, other_versions
from tests.leaderboard.command_line import main
from tests.leaderboard.record_factory import make_curve, make_evaluation, make_record

REPOSITORY = Path(__file__).parents[2]


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("verify")
    generator = np.random.default_rng(0)
    for seed in range(2):
        for agent in ("base", "standard", "equivariant"):
            curve = make_curve(generator, [0.35, 0.5, 0.65])
            if agent == "base":
                curve = [make_evaluation(generator.random(100) < 0.35)]
            record = make_record(curve, agent=agent, seed=seed, variant="action_gain:0.5")
            write_record(record, folder / "records" / f"{record.run_id}.json")
    generate([folder / "records"], folder / "board")
    return folder


@pytest.fixture
def board(written: Path, tmp_path: Path) -> Path:
    """A copy of the leaderboard beside its records, to be damaged."""
    shutil.copytree(written, tmp_path / "copy")
    return tmp_path / "copy" / "board"


def snapshot(folder: Path) -> dict[str, bytes | None]:
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }


def call(board: Path, capsys: pytest.CaptureFixture[str]) -> tuple[int, list[str], str]:
    """Exit code, lines of stdout, stderr; and nothing may have changed on disk."""
    before = snapshot(board.parent)
    code = main(["--verify", str(board.parent / "records"), "--out", str(board)])
    assert snapshot(board.parent) == before
    shown = capsys.readouterr()
    return code, shown.out.splitlines(), shown.err


def test_what_was_generated_agrees(board: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (board / "figures" / "mine.svg").write_text("not ours")
    (board / "NOTES.md").write_text("not ours")
    code, lines, error = call(board, capsys)
    assert (code, error) == (0, "")
    assert len(lines) == 1
    files = len(snapshot(board)) - 3
    assert f"6 records and {files} files of the leaderboard agree" in lines[0]
    code, lines, _ = call(board.parent / "elsewhere", capsys)
    assert code == 1
    assert all(line.endswith(": missing") for line in lines)
    # Without one record the page is another one.
    next((board.parent / "records").iterdir()).unlink()
    code, lines, _ = call(board, capsys)
    assert code == 1
    assert {"LEADERBOARD.md", "leaderboard.csv"} <= {Path(s.split(": ")[0]).name for s in lines}


def test_each_file_that_differs_has_its_line(
    board: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page, table = board / "LEADERBOARD.md", board / "leaderboard.csv"
    page.write_text(page.read_text().replace("## Details", "## Detail", 1))
    # The line ends that a careless checkout makes.
    table.write_bytes(table.read_bytes().replace(b"\n", b"\r\n"))
    first, second, *_ = sorted((board / "figures").iterdir())
    first.unlink()
    second.write_bytes(second.read_bytes() + b"\n")
    stale = board / "figures" / f"q-{slug('OldTask-v1', 'floating')}.svg"
    stale.write_text("")
    code, lines, error = call(board, capsys)
    assert code == 1
    assert error.startswith("error: 5 files")
    assert error.count("\n") == 1
    assert len(lines) == 5
    shown = dict(line.split(": ", 1) for line in lines)
    number = page.read_text().splitlines().index("## Detail") + 1
    assert shown[str(page)] == f"differs from line {number} on"
    assert shown[str(table)] == "differs from line 1 on"
    assert shown[str(first)] == "missing"
    assert shown[str(second)].startswith("differs from line ")
    assert shown[str(stale)] == "no record gives this file"


def test_another_kind_of_machine_gives_the_same_bytes(written: Path, tmp_path: Path) -> None:
    """Another folder, home, style, time zone, hash seed, instruction set and number of threads."""
    (tmp_path / "matplotlibrc").write_text("font.size: 20\nlines.linewidth: 5\npath.sketch: 1,2,3")
    environment = os.environ | {
        "PYTHONHASHSEED": "7",
        "HOME": str(tmp_path),
        "MPLCONFIGDIR": str(tmp_path),
        "LC_ALL": "C",
        "TZ": "Asia/Tokyo",
        "OMP_NUM_THREADS": "2",
        "OPENBLAS_CORETYPE": "Nehalem",
        "NPY_DISABLE_CPU_FEATURES": "AVX2 FMA3",
        "GLIBC_TUNABLES": "glibc.cpu.hwcaps=-AVX2,-FMA",
        "PYTHONPATH": str(REPOSITORY),
    }
    command = [sys.executable, "-m", "symsteer", "report", str(written / "records"), "--verify"]
    result = subprocess.run(
        [*command, "--out", str(written / "board")],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
    )
    assert (result.returncode, result.stdout.count("\n")) == (0, 1), result.stdout + result.stderr


def test_pinned_versions_are_those_that_run() -> None:
    """In the environment of `make setup`; elsewhere `--verify` names what differs."""
    assert other_versions() == []


def test_differences_are_short_and_printable(tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"\x1b[2J" + b"x" * 10**6)
    (tmp_path / "b").mkdir()
    (tmp_path / "c").symlink_to(tmp_path / "c")
    lines = differences({"a": b"y", "b": b"", "c": b"", "d/e": b""}, [], tmp_path)
    assert [line.split(": ")[0] for line in lines] == [
        str(tmp_path / name) for name in ("a", "b", "c", "d/e")
    ]
    assert all(line.isprintable() and len(line) < len(str(tmp_path)) + 140 for line in lines)
    assert "Is a directory" in lines[1]
