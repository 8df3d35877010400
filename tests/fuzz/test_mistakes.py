"""Mistakes of users, some for every verb: one sentence and exit code 2, before any work begins."""

from __future__ import annotations

import shutil

import pytest

from tests.fuzz.judge import end_of

MISTAKES = """
list extra
run --task Nothing
run --variant action_gain:0.5,wind:0.3
run --base-policy file
run --demos folder.h5
run --num-envs many
run --num-envs 99999999
run --policy.steps 0
run --env-steps 100
sweep nowhere.toml
sweep smoke --runs file
sweep smoke --workers automatic
resume loop
resume
evaluate nowhere
evaluate folder --episodes -1
status nowhere
report nowhere
report x.json
report folder --verify
compare folder folder
compare standard equivariant --runs folder
reproduce file
advise --task Nothing
advise --task PickCube-v1 --variant wnid:1
advise --task PickCube-v1 --audit x.json
advise --audit x.json
advise --task PickCube-v1 --runs folder
audit --task Nothing
audit --group E8
audit-episodes --actions nobody
audit --base-policy folder
audit --variant all
audit --out file
throughput --agent nobody
throughput --agent zero
demos
demos file/a.h5
demos a.h5 --seed 99999999999999
export
export nowhere --out a.zip
export nowhere --out folder
export-lerobot
export-lerobot file --out file
fetch-bundle x.json
fetch-bundle https://example.org/a.zip
doctor extra
demo --runs file
"""


@pytest.fixture
def place(tmp_path, monkeypatch):
    """A folder with things of the wrong kind."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").write_text("text")
    (tmp_path / "x.json").write_text("{}")
    for name in ("folder", "folder.toml", "folder.h5"):
        (tmp_path / name).mkdir()
    (tmp_path / "loop").symlink_to("loop")
    return tmp_path


def listing(folder):
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


@pytest.mark.parametrize("line", MISTAKES.strip().splitlines())
def test_a_mistake_is_told_in_one_sentence(line, place):
    before = listing(place)
    assert end_of(line.split()).kind in ("refused", "usage")
    # A folder that results would have gone to may be there, but nothing in it.
    shutil.rmtree(place / "runs", ignore_errors=True)
    assert listing(place) == before
