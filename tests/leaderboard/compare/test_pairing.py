"""What the names A and B mean, which runs are paired, and what is said of the others."""

from __future__ import annotations

import shutil
from itertools import product
from pathlib import Path

import pytest

from symsteer.errors import UserError
from symsteer.leaderboard.compare.sides import read_sides
from symsteer.leaderboard.records.retired import RETIRED
from tests.leaderboard.compare.runs import at_commit, changed, runs_of, save
from tests.leaderboard.record_factory import edited, make_evaluation, make_record

CURVES = [[[1, 0, 1]], [[0, 0, 1]], [[1, 1, 1]]]
NESTED = {"lr": 0.1, "depth": 2}
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


def test_a_commit_is_named_by_its_beginning(place):
    """Of an installed package it is the hash of its code."""
    code = {"commit": None, "dirty": None, "sha256": "beef" * 16}
    installed = {f"provenance/{name}": value for name, value in code.items()}
    save(place / "runs/installed", [edited(make_record(agent="zero"), installed)])
    for prefix, agent in (("aaaa2", "equivariant"), ("AAAA2222", "equivariant"), ("beef", "zero")):
        _, b = read_sides("standard", prefix, Path("runs"))
        assert (b.kind, {*agents(b)}) == ("commit", {agent})


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


def test_a_path_comes_before_an_agent_and_a_run_belongs_to_one_side(place):
    a, b = read_sides("standard", "equivariant", Path("runs"))
    assert (a.kind, agents(a)) == ("agent", ["standard"] * 2)
    assert (b.kind, agents(b)) == ("agent", ["equivariant"] * 2)
    shutil.copytree(place / "runs/more", place / "standard")
    a, b = read_sides("standard", "runs/some", Path("runs"))
    assert (a.kind, agents(a)) == ("folder", ["equivariant"] * 2)
    assert (b.kind, agents(b)) == ("folder", ["standard"] * 2)
    a, _ = read_sides("runs/more/run-1/record.json", "runs/some", Path("runs"))
    assert (a.kind, [run.seed for run in a.runs]) == ("file", [1])
    with pytest.raises(UserError, match="2 of the runs belong to A"):
        read_sides("runs", "runs/more", Path("runs"))


def test_unfinished_and_older_runs_are_left_over(place):
    folder = place / "again"
    times = {"started": "2027-01-31T12:00:00+00:00", "ended": "2027-01-31T13:00:00+00:00"}
    newer = edited(make_record([make_evaluation([1, 1])]), times)
    save(folder, [make_record(seed=0), newer, make_record(status="interrupted", seed=1)])
    a, _ = read_sides(str(folder), "standard", Path("runs"))
    assert [run.record for run in a.runs] == [newer]
    reasons = {found.run.seed: found.reason for found in a.leftovers}
    assert reasons == {0: "a newer record of the same run", 1: "not finished: interrupted"}
    save(place / "begun", [make_record(status="running")])
    with pytest.raises(UserError, match="begun has no finished run among 1 records"):
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


# Pairs


def test_the_same_runs_of_other_code_are_paired_by_seed(tmp_path: Path):
    """In two folders, or as two commits; settings of the machine need not agree."""
    records = runs_of(*CURVES, agent="standard") + runs_of(*CURVES, agent="base")
    moved = runs_of(*CURVES, agent="standard", device="cuda") + records[3:]
    a = save(tmp_path / "a", at_commit(records, "a" * 40))
    b = save(tmp_path / "b", at_commit(reversed(moved), "f" * 40))
    found = changed(a, b)
    assert found == changed("aaaa", "ffff", tmp_path)
    assert [cell.label for cell in found.cells] == ["base", "standard"]
    for pair in found.pairs:
        assert pair.a.path != pair.b.path
        assert pair.a.seed == pair.b.seed
    assert len(found.pairs) == 6
    assert found.alone == ((), ())
    assert found.one_sided == ((), ())


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"task": "PushCube-v1"}, "task (PickCube-v1, PushCube-v1)"),
        ({"variant": "wind:1", "evaluation_variant": "wind:1"}, "variant (none, wind:1);"),
        ({"first_seed": 1}, "seed (0, 1)"),
        ({"demonstrations": {"mode": "diverse", "count": 10, "seed": 0}}, "demonstrations.count"),
        ({"evaluation": {"episodes": 20}}, "evaluation.episodes (10, 20)"),
        ({"policies": True}, "base policy"),
    ],
)
def test_all_but_the_agent_must_agree(tmp_path: Path, change, words):
    usual = {"evaluation": {"episodes": 10}}
    a = save(tmp_path / "a", runs_of(CURVES[0], agent="standard", **usual))
    b = save(tmp_path / "b", runs_of(CURVES[0], agent="equivariant", **(usual | change)))
    with pytest.raises(UserError) as error:
        changed(a, b)
    assert f"differ in {words}" in str(error.value)


def test_the_episodes_must_agree(tmp_path: Path):
    a = save(tmp_path / "a", [make_record([make_evaluation([1, 0])])])
    b = save(tmp_path / "b", [make_record([make_evaluation([1, 0], first_seed=7)])])
    with pytest.raises(UserError, match=r"held-out episodes \(\[10000, 10001\], \[7, 8\]\)"):
        changed(a, b)


def test_two_agents_are_paired_whatever_their_options(tmp_path: Path):
    save(tmp_path / "a", runs_of(*CURVES, agent="standard", agent_options=NESTED))
    save(tmp_path / "b", runs_of(*CURVES[:2], agent="equivariant", agent_options={"group": "C8"}))
    found = changed("standard", "equivariant", tmp_path)
    assert [(pair.a.agent, pair.b.agent) for pair in found.pairs] == [
        ("standard", "equivariant")
    ] * 2
    assert [cell.label for cell in found.cells] == [""]
    assert found.changed == ()
    (left,) = found.alone[0]
    assert (left.run.seed, left.reason) == (2, "the nearest run of B differs in seed")
    assert found.alone[1] == ()


def test_one_set_of_options_against_another(tmp_path: Path):
    a = save(tmp_path / "a", runs_of(*CURVES, agent_options=NESTED))
    b = save(tmp_path / "b", runs_of(*CURVES, agent_options=NESTED | {"lr": 0.2, "new": True}))
    found = changed(a, b)
    assert len(found.pairs) == 3
    assert found.changed == ("lr 0.1 -> 0.2", "new unset -> true")


def test_of_several_agents_the_agent_and_its_options_must_agree(tmp_path: Path):
    zero, base, standard = (runs_of(*CURVES, agent=name) for name in ("zero", "base", "standard"))
    options = [runs_of(*CURVES, agent_options=NESTED | {"lr": lr}) for lr in (0.1, 0.2)]
    for word, first, second in (("agent", base, standard), ("lr", *options)):
        a = save(tmp_path / word / "a", zero + first)
        b = save(tmp_path / word / "b", zero + second)
        found = changed(a, b)
        assert {(pair.a.agent, pair.b.agent) for pair in found.pairs} == {("zero", "zero")}
        for letter, alone in zip("BA", found.alone, strict=True):
            reason = f"the nearest run of {letter} differs in {word}"
            assert [left.reason for left in alone] == [reason] * 3


def test_a_setting_that_one_side_does_not_know_does_not_count(tmp_path: Path):
    zero = runs_of(*CURVES, agent="zero")
    a = save(tmp_path / "a", runs_of(*CURVES, agent_options=NESTED, old=1) + zero)
    b = save(tmp_path / "b", runs_of(*CURVES, agent_options=NESTED | {"new": True}) + zero)
    found = changed(a, b)
    assert len(found.pairs) == 6
    assert found.one_sided == (("old",), ("agent_options.new",))


def test_an_option_that_is_no_more_has_its_one_value(tmp_path: Path):
    options = {"target_entropy": 0.5, "lr": 0.1}
    agents = ("standard", "equivariant")

    def side(name: str, **more: object) -> Path:
        runs = [r for a in agents for r in runs_of(*CURVES, agent=a, agent_options=options | more)]
        return save(tmp_path / name, runs)

    old, new, other = side("old", **RETIRED), side("new"), side("other", n_step=3)
    found = changed(old, new)
    assert len(found.pairs) == 6
    assert (found.one_sided, found.changed) == (((), ()), ())
    with pytest.raises(UserError, match=r"differ in agent_options|differ in n_step \(1, 3\)"):
        changed(old, other)


def test_a_run_has_one_partner(tmp_path: Path):
    zero = runs_of(*CURVES, agent="zero")
    twice = [
        record
        for value in (1, 2)
        for record in runs_of(*CURVES, agent_options=NESTED | {"new": value})
    ]
    a = save(tmp_path / "a", runs_of(*CURVES, agent_options=NESTED) + zero)
    b = save(tmp_path / "b", twice + zero)
    for first, second, side in ((a, b, 1), (b, a, 0)):
        found = changed(first, second)
        paths = [run.path for pair in found.pairs for run in (pair.a, pair.b)]
        assert len(paths) == len(set(paths)) == 12
        reason = f"its run of {'BA'[side]} has another partner"
        assert [left.reason for left in found.alone[side]] == [reason] * 3


@pytest.mark.parametrize(
    ("place", "value", "episodes", "diagnostics"),
    [
        ("wall_clock", 1.0, True, True),
        ("episodes/return/1", -9.0, False, True),
        ("diagnostics/q_bias", 7.0, True, False),
    ],
)
def test_what_agrees_bit_for_bit(tmp_path: Path, place, value, episodes, diagnostics):
    (record,) = runs_of([[1, 1], [0, 1], [1, 1]])
    other = edited(record, {f"evaluations/1/{place}": value})
    (pair,) = changed(save(tmp_path / "a", [record]), save(tmp_path / "b", [other])).pairs
    assert (pair.same_episodes, pair.same_diagnostics) == (episodes, diagnostics)
