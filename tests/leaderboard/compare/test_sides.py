"""What the names A and B mean."""

from __future__ import annotations

import os
import shutil
from itertools import product
from pathlib import Path

import pytest

from symsteer.errors import UserError
from symsteer.leaderboard.compare.sides import read_sides
from tests.leaderboard.compare.runs import at_commit, runs_of, save
from tests.leaderboard.record_factory import make_evaluation, make_record

GOOD = [[[1, 0]]] * 2
OLD, NEW = "aaaa1111" * 5, "aaaa2222" * 5


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Two agents and two commits, some levels deep; the present folder is the one above."""
    monkeypatch.chdir(tmp_path)
    standard, equivariant = (runs_of(*GOOD, agent=name) for name in ("standard", "equivariant"))
    save(tmp_path / "runs/some/deep/standard-runs", at_commit(standard, OLD))
    save(tmp_path / "runs/more", at_commit(equivariant, NEW))
    return tmp_path


def agents(side):
    return sorted(run.agent for run in side.runs)


def test_agents_are_found_at_any_depth(place):
    a, b = read_sides("standard", "equivariant", Path("runs"))
    assert (a.kind, b.kind) == ("agent", "agent")
    assert agents(a) == ["standard"] * 2
    assert agents(b) == ["equivariant"] * 2


@pytest.mark.parametrize("prefix", ["aaaa2", "AAAA2222", NEW])
def test_a_commit_is_named_by_its_beginning(place, prefix):
    _, b = read_sides("standard", prefix, Path("runs"))
    assert b.kind == "commit"
    assert agents(b) == ["equivariant"] * 2


def test_of_an_installed_package_the_hash_of_the_code_is_the_commit(place):
    record = make_record(agent="zero")
    record.provenance.commit, record.provenance.dirty = None, None
    record.provenance.sha256 = "beef" * 16
    save(place / "runs/installed", [record])
    _, b = read_sides("standard", "beefbeef", Path("runs"))
    assert (b.kind, agents(b)) == ("commit", ["zero"])


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("aaaa", ["2 commits", "aaaa1111aaaa", "aaaa2222aaaa", "more digits"]),
        ("aaa", ["no folder, agent or commit 'aaa'", "aaaa1111"]),
        ("bbbb", ["'bbbb'"]),
        ("standrad", ["did you mean 'standard'"]),
        ("runs/mroe", ["'runs/mroe'", "equivariant, standard"]),
        ("", ["''"]),
    ],
)
def test_a_name_that_means_nothing(place, name, words):
    with pytest.raises(UserError) as error:
        read_sides(name, "standard", Path("runs"))
    assert all(word in str(error.value) for word in words), error.value


def test_a_path_comes_before_an_agent(place):
    shutil.copytree(place / "runs/more", place / "standard")
    a, b = read_sides("standard", "runs/some", Path("runs"))
    assert (a.kind, agents(a)) == ("folder", ["equivariant"] * 2)
    assert (b.kind, agents(b)) == ("folder", ["standard"] * 2)


def test_one_record_is_a_side(place):
    a, _ = read_sides("runs/more/run-1/record.json", "standard", Path("runs"))
    assert (a.kind, [run.seed for run in a.runs]) == ("file", [1])


def test_without_records_to_look_in(place):
    os.rename("runs", "results")
    with pytest.raises(UserError, match=r"no folder runs .*--runs"):
        read_sides("standard", "equivariant", Path("runs"))
    # Paths need none.
    read_sides("results/some", "results/more", Path("runs"))


def test_a_run_belongs_to_one_side(place):
    with pytest.raises(UserError, match="2 of the runs belong to A"):
        read_sides("runs", "runs/more", Path("runs"))
    with pytest.raises(UserError, match="belong to A"):
        read_sides("standard", "aaaa1", Path("runs"))


def test_unfinished_and_older_runs_are_left_over(place):
    folder = place / "again"
    newer = make_record([make_evaluation([1, 1])], seed=0)
    newer.started = newer.started.replace(year=2027)
    newer.ended = newer.ended.replace(year=2027)
    save(folder, [make_record(seed=0), newer, make_record(status="interrupted", seed=1)])
    a, _ = read_sides(str(folder), "standard", Path("runs"))
    assert [run.record for run in a.runs] == [newer]
    reasons = {found.run.seed: found.reason for found in a.leftovers}
    assert reasons == {0: "a newer record of the same run", 1: "not finished: interrupted"}


def test_only_unfinished_runs(place):
    save(
        place / "begun", [make_record(status="interrupted"), make_record(status="running", seed=1)]
    )
    with pytest.raises(UserError, match="begun has no finished run among 2 records"):
        read_sides("begun", "standard", Path("runs"))


def test_an_agent_stands_for_its_usual_settings(place):
    others = runs_of(*GOOD[:1], agent="standard", learning_rate=0.1)
    save(place / "runs/others", others)
    a, _ = read_sides("standard", "equivariant", Path("runs"))
    assert [run.record.config["learning_rate"] for run in a.runs] == [3e-4] * 2
    (left,) = a.leftovers
    assert left.reason == "other settings: standard (learning_rate 0.1)"


def test_all_settings_of_a_grid_stand_for_an_agent(tmp_path: Path):
    for tau, utd in product((0.005, 0.05), (1.0, 4.0)):
        for agent in ("standard", "equivariant"):
            runs = runs_of(*GOOD, agent=agent, agent_options={"tau": tau, "utd": utd})
            save(tmp_path / f"{agent}-{tau}-{utd}", runs)
    a, b = read_sides("standard", "equivariant", tmp_path)
    assert [key.settings for key, _ in a.rows] == [key.settings for key, _ in b.rows]
    assert (len(a.rows), len(a.runs), a.leftovers) == (4, 8, ())


@pytest.mark.parametrize("text", ["{}", "[1]", "{", '{"schema_version": 5, "run_id": "x"}', "\0"])
def test_foreign_and_damaged_records_are_named(place, text):
    (place / "runs/more/run-0/record.json").write_text(text)
    with pytest.raises(UserError, match=r"more/run-0/record\.json"):
        read_sides("runs/some", "runs/more", Path("runs"))
