"""What a record says about the code that ran."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from symsteer.leaderboard.records import Provenance, provenance
from symsteer.registry import Extension
from tests.leaderboard.command_line import git

REPOSITORY = Path(__file__).parents[2]


def test_code_that_git_does_not_track_counts_as_a_local_change(tmp_path: Path) -> None:
    def dirty() -> bool | None:
        return provenance.commit_of(tmp_path)[1]

    (tmp_path / "agents").mkdir()
    (tmp_path / "agents" / "mine.py").write_text("")
    (tmp_path / "symsteer").mkdir()
    (tmp_path / "symsteer" / "agents").symlink_to("../agents")
    (tmp_path / ".gitignore").write_text("*_cache/\n")
    git(tmp_path, "init", "-q")
    git(tmp_path, "add", ".")
    git(tmp_path, "commit", "-qm", "first")
    (tmp_path / "notes.txt").write_text("no code")
    (tmp_path / "scratch.py").write_text("no code of ours")
    (tmp_path / "agents" / "a_cache").mkdir()
    (tmp_path / "agents" / "a_cache" / "kept.py").write_text("")
    assert dirty() is False
    (tmp_path / "agents" / "another.py").write_text("")
    assert dirty() is True
    (tmp_path / "agents" / "another.py").unlink()
    (tmp_path / "agents" / "mine.py").write_text("1")
    assert dirty() is True


def test_only_a_checkout_that_tracks_the_code_is_its_checkout(tmp_path: Path) -> None:
    """An installed copy in a virtual environment may lie in some repository, or in ours."""
    code = tmp_path / "symsteer" / "registry.py"
    installed = tmp_path / ".venv" / "site-packages" / "symsteer" / "registry.py"
    for file in (code, installed):
        file.parent.mkdir(parents=True)
        file.write_text("")
    assert provenance._checkout_of(code) is None
    git(tmp_path, "init", "-q")
    assert provenance._checkout_of(code) is None
    git(tmp_path, "add", "symsteer")
    assert provenance._checkout_of(code) == tmp_path
    assert provenance._checkout_of(installed) is None
    git(tmp_path, "add", "-f", ".venv")
    assert provenance._checkout_of(installed) is None


def test_the_code_is_named_by_a_commit_or_by_its_hash(monkeypatch: pytest.MonkeyPatch) -> None:
    extension = Extension("agent", "mine", "mine:Mine", None, None, "ab" * 32)
    here = Provenance.collect("cpu", 1, [extension])
    assert here.packages["numpy"] == np.__version__
    assert [e.model_dump() for e in here.extensions] == [extension.to_json()]
    # Only Linux names the processor, and not on every machine.
    cpu = Path("/proc/cpuinfo")
    name = re.search(r"^model name\s*: (.+)$", cpu.read_text() if cpu.is_file() else "", re.M)
    assert (here.processor or "").startswith(name[1] if name else "")
    if provenance.checkout() == REPOSITORY:
        assert here.commit is not None
        assert here.sha256 is None
    monkeypatch.setattr(provenance, "checkout", lambda: None)
    installed = Provenance.collect("cpu", 1)
    assert (installed.commit, installed.dirty, installed.extensions) == (None, None, [])
    assert installed.sha256 is not None
    assert installed.version == here.version
