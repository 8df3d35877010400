"""Which runs are paired, and what is said of the others."""

from __future__ import annotations

from pathlib import Path

import pytest

from symsteer.errors import UserError
from symsteer.leaderboard.records.retired import RETIRED
from tests.leaderboard.compare.runs import at_commit, paired, runs_of, save
from tests.leaderboard.record_factory import make_evaluation, make_record

CURVES = [[[1, 0, 1]], [[0, 0, 1]], [[1, 1, 1]]]
NESTED = {"lr": 0.1, "depth": 2}


def test_the_same_runs_of_other_code_are_paired_by_seed(tmp_path: Path):
    records = runs_of(*CURVES, agent="standard") + runs_of(*CURVES, agent="base")
    a = save(tmp_path / "a", records)
    b = save(tmp_path / "b", at_commit(reversed(records), "f" * 40))
    found = paired(a, b)
    assert [cell.label for cell in found.cells] == ["base", "standard"]
    for pair in found.pairs:
        assert pair.a.path != pair.b.path
        assert pair.a.record.config == pair.b.record.config
    assert len(found.pairs) == 6
    assert found.alone == ((), ())
    assert found.one_sided == ((), ())


def test_commits_of_one_folder(tmp_path: Path):
    records = runs_of(*CURVES) + runs_of(*CURVES, agent="zero")
    save(tmp_path / "old", at_commit(records, "a" * 40))
    save(tmp_path / "new", at_commit(records, "b" * 40))
    found = paired("aaaa", "bbbb", tmp_path)
    assert len(found.pairs) == 6
    assert {pair.a.record.provenance.commit for pair in found.pairs} == {"a" * 40}
    assert {pair.b.record.provenance.commit for pair in found.pairs} == {"b" * 40}


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"task": "PushCube-v1"}, "task (PickCube-v1, PushCube-v1)"),
        ({"embodiment": "panda"}, "embodiment (floating, panda)"),
        ({"variant": "wind:1", "evaluation_variant": "wind:1"}, "variant (none, wind:1);"),
        ({"first_seed": 1}, "seed (0, 1)"),
        ({"env_steps": 60_000}, "env_steps (50000, 60000)"),
        (
            {"demonstrations": {"mode": "diverse", "count": 10, "seed": 0}},
            "demonstrations.count (50, 10)",
        ),
        (
            {"demonstrations": {"mode": "diverse", "count": 50, "seed": 9}},
            "demonstrations.seed (0, 9)",
        ),
        ({"evaluation": {"episodes": 20}}, "evaluation.episodes (10, 20)"),
        ({"num_envs": 32}, "num_envs (64, 32)"),
        ({"policies": True}, "base policy"),
    ],
)
@pytest.mark.parametrize("agents", [("standard", "standard"), ("standard", "equivariant")])
def test_all_but_the_agent_must_agree(tmp_path: Path, change, words, agents):
    usual = {"evaluation": {"episodes": 10}, "num_envs": 64}
    a = save(tmp_path / "a", runs_of(CURVES[0], agent=agents[0], **usual))
    b = save(tmp_path / "b", runs_of(CURVES[0], agent=agents[1], **(usual | change)))
    with pytest.raises(UserError) as error:
        paired(a, b)
    assert f"differ in {words}" in str(error.value)


def test_the_episodes_must_agree(tmp_path: Path):
    a = save(tmp_path / "a", [make_record([make_evaluation([1, 0])])])
    b = save(tmp_path / "b", [make_record([make_evaluation([1, 0], first_seed=7)])])
    with pytest.raises(UserError, match=r"held-out episodes \(\[10000, 10001\], \[7, 8\]\)"):
        paired(a, b)


def test_settings_of_the_machine_need_not_agree(tmp_path: Path):
    a = save(tmp_path / "a", runs_of(*CURVES, device="cpu"))
    b = save(tmp_path / "b", runs_of(*CURVES, device="cuda"))
    assert len(paired(a, b).pairs) == 3


def test_two_agents_are_paired_whatever_their_options(tmp_path: Path):
    save(tmp_path / "a", runs_of(*CURVES, agent="standard", agent_options=NESTED))
    save(tmp_path / "b", runs_of(*CURVES[:2], agent="equivariant", agent_options={"group": "C8"}))
    found = paired("standard", "equivariant", tmp_path)
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
    found = paired(a, b)
    assert len(found.pairs) == 3
    assert found.changed == ("lr 0.1 -> 0.2", "new unset -> true")


def test_of_several_agents_the_options_must_agree(tmp_path: Path):
    zero = runs_of(*CURVES, agent="zero")
    a = save(tmp_path / "a", runs_of(*CURVES, agent_options=NESTED) + zero)
    b = save(tmp_path / "b", runs_of(*CURVES, agent_options=NESTED | {"lr": 0.2}) + zero)
    found = paired(a, b)
    assert {pair.a.agent for pair in found.pairs} == {"zero"}
    for letter, alone in zip("BA", found.alone, strict=True):
        assert [left.reason for left in alone] == [f"the nearest run of {letter} differs in lr"] * 3


def test_agents_of_several_are_not_paired_with_each_other(tmp_path: Path):
    zero, base, standard = (runs_of(*CURVES, agent=name) for name in ("zero", "base", "standard"))
    a, b = save(tmp_path / "a", zero + base), save(tmp_path / "b", zero + standard)
    found = paired(a, b)
    assert {(pair.a.agent, pair.b.agent) for pair in found.pairs} == {("zero", "zero")}
    assert {left.reason for left in found.alone[0]} == {"the nearest run of B differs in agent"}


def test_one_agent_meets_itself_among_several(tmp_path: Path):
    standard, zero = (runs_of(*CURVES, agent=name) for name in ("standard", "zero"))
    a, b = save(tmp_path / "a", standard), save(tmp_path / "b", standard + zero)
    for first, second in ((a, b), (b, a)):
        found = paired(first, second)
        assert {(pair.a.agent, pair.b.agent) for pair in found.pairs} == {("standard", "standard")}


def test_a_setting_that_one_side_does_not_know_does_not_count(tmp_path: Path):
    zero = runs_of(*CURVES, agent="zero")
    a = save(tmp_path / "a", runs_of(*CURVES, agent_options=NESTED, old=1) + zero)
    b = save(tmp_path / "b", runs_of(*CURVES, agent_options=NESTED | {"new": True}) + zero)
    found = paired(a, b)
    assert len(found.pairs) == 6
    assert found.one_sided == (("old",), ("agent_options.new",))


def test_an_option_that_is_no_more_has_its_one_value(tmp_path: Path):
    options = {"target_entropy": 0.5, "lr": 0.1}
    agents = ("standard", "equivariant")

    def side(name: str, **more: object) -> Path:
        runs = [r for a in agents for r in runs_of(*CURVES, agent=a, agent_options=options | more)]
        return save(tmp_path / name, runs)

    old, new, other = side("old", **RETIRED), side("new"), side("other", n_step=3)
    found = paired(old, new)
    assert len(found.pairs) == 6
    assert (found.one_sided, found.changed) == (((), ()), ())
    with pytest.raises(UserError, match=r"differ in agent_options|differ in n_step \(1, 3\)"):
        paired(old, other)


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
        found = paired(first, second)
        paths = [run.path for pair in found.pairs for run in (pair.a, pair.b)]
        assert len(paths) == len(set(paths)) == 12
        reason = f"its run of {'BA'[side]} has another partner"
        assert [left.reason for left in found.alone[side]] == [reason] * 3


@pytest.mark.parametrize(
    ("field", "episodes", "diagnostics"),
    [
        (None, True, True),
        ("success_at_end", False, True),
        ("return_", False, True),
        ("episode_len", False, True),
        ("diagnostics", True, False),
        ("wall_clock", True, True),
    ],
)
def test_what_agrees_bit_for_bit(tmp_path: Path, field, episodes, diagnostics):
    curve = [[[1, 1], [0, 1], [1, 1]]]
    a, b = runs_of(*curve), runs_of(*curve)
    middle = b[0].evaluations[1]
    if field == "diagnostics":
        middle.diagnostics = {"q_bias": 7.0}
    elif field == "wall_clock":
        middle.wall_clock += 1
    elif field == "success_at_end":
        middle.episodes.success_at_end = [False, False]
    elif field is not None:
        values = list(getattr(middle.episodes, field))
        values[1] += 1
        setattr(middle.episodes, field, values)
    (pair,) = paired(save(tmp_path / "a", a), save(tmp_path / "b", b)).pairs
    assert (pair.same_episodes, pair.same_diagnostics) == (episodes, diagnostics)
