"""What a record says about the code that ran."""

from __future__ import annotations

import subprocess
from pathlib import Path

from symsteer.leaderboard.records import Provenance


def test_code_that_git_does_not_know_counts_as_a_local_change(tmp_path: Path) -> None:
    def git(*arguments: str) -> None:
        identity = ["-c", "user.name=a", "-c", "user.email=a@b", "-c", "commit.gpgsign=false"]
        subprocess.run(["git", *identity, *arguments], cwd=tmp_path, check=True)

    def dirty() -> bool | None:
        return Provenance.collect("cpu", 1, tmp_path, []).dirty

    (tmp_path / "agents").mkdir()
    (tmp_path / "agents" / "mine.py").write_text("")
    (tmp_path / ".gitignore").write_text("*_cache/\n")
    git("init", "-q")
    git("add", ".")
    git("commit", "-qm", "first")
    (tmp_path / "notes.txt").write_text("no code")
    (tmp_path / "scratch.py").write_text("no code of ours")
    (tmp_path / "agents" / "a_cache").mkdir()
    (tmp_path / "agents" / "a_cache" / "kept.py").write_text("")
    assert dirty() is False
    (tmp_path / "agents" / "another.py").write_text("")
    assert dirty() is True
    git("add", ".")
    git("commit", "-qm", "second")
    assert dirty() is False
    (tmp_path / "agents" / "mine.py").write_text("1")
    assert dirty() is True
