"""`--check`: each rule has a record that breaks only it."""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from symsteer.errors import UserError
from symsteer.leaderboard import command
from symsteer.leaderboard.admission import RULES, Verdict, check
from symsteer.leaderboard.records import (
    HELD_OUT_SEED,
    RecordedExtension,
    RunRecord,
    config_hash,
    write_record,
)
from tests.leaderboard.command_line import main
from tests.leaderboard.record_factory import LEARNING, make_curve, make_evaluation, make_record

REPOSITORY = Path(__file__).parents[2]
COMMIT = subprocess.run(
    ["git", "-C", str(REPOSITORY), "rev-parse", "HEAD"], capture_output=True, text=True
).stdout.strip()


def admissible(agent: str = "standard", seed: int = 0, **config: Any) -> RunRecord:
    """A record that the leaderboard admits; `seed` also decides what it measured."""
    curve = make_curve(np.random.default_rng(seed), [0.3, 0.5, 0.7])
    if agent not in LEARNING:
        steps = make_record(agent=agent, **config).budget.env_steps
        curve = [make_evaluation([1, 0] * 50, steps)]
    for evaluation in curve:
        number = len(evaluation.episodes.seed)
        evaluation.episodes.seed = [HELD_OUT_SEED + i for i in range(number)]
    record = make_record(curve, agent=agent, seed=seed, **config)
    record.provenance.commit = COMMIT or record.provenance.commit
    cell = record.settings
    variant = cell.variant.replace(":", "=")
    record.run_id = f"{cell.task}-{cell.embodiment}-{variant}-{agent}-s{seed}-0123456789ab"
    return record


def store(record: RunRecord, folder: Path, name: str | None = None) -> Path:
    path = folder / (name or f"{record.run_id}.json")
    write_record(record, path)
    return path


def judge(*paths: Path, committed: Path = Path("/nowhere")) -> list[Verdict]:
    return check(paths, committed)


def five(folder: Path, **config: Any) -> list[Path]:
    return [store(admissible(seed=seed, **config), folder) for seed in range(5)]


def test_five_seeds_are_admitted_without_a_word(tmp_path: Path) -> None:
    verdicts = judge(*five(tmp_path), store(admissible("base"), tmp_path))
    assert all(verdict.is_admissible and not verdict.notes for verdict in verdicts)
    assert [verdict.path.name for verdict in verdicts][:2] == [
        "PickCube-v1-floating-none-standard-s0-0123456789ab.json",
        "PickCube-v1-floating-none-standard-s1-0123456789ab.json",
    ]


def failed(record: RunRecord) -> None:
    record.evaluations = record.evaluations[:-1]
    record.status, record.failure = "failed", "out of memory"


def interrupted(record: RunRecord) -> None:
    record.evaluations[-1].final = False
    record.status = "interrupted"


def no_commit(record: RunRecord) -> None:
    record.provenance.commit = record.provenance.dirty = None


def unreleased(record: RunRecord) -> None:
    record.provenance.commit = record.provenance.dirty = None
    record.provenance.version, record.provenance.sha256 = "0.2.dev3+g0123456", "cd" * 32


def extension(**changes: Any) -> RecordedExtension:
    data = {"kind": "agent", "name": "mine:Mine", "target": "mine:Mine", "sha256": "ab" * 32}
    return RecordedExtension(**({"distribution": None, "version": None} | data | changes))


def loose_extension(record: RunRecord) -> None:
    record.provenance.extensions = [extension()]


def local_changes(record: RunRecord) -> None:
    record.provenance.dirty = True


def continued_with_changes(record: RunRecord) -> None:
    record.continued = [
        record.provenance.model_copy(update={"dirty": False}),
        record.provenance.model_copy(update={"dirty": True}),
    ]


def continued_without_commit(record: RunRecord) -> None:
    record.continued = [record.provenance.model_copy(update={"commit": None, "dirty": None})]


def few_episodes(record: RunRecord) -> None:
    columns = record.evaluations[-1].episodes
    record.evaluations[-1].episodes = type(columns).model_validate(
        {name: column[:99] for name, column in columns.model_dump(by_alias=True).items() if column}
    )


def chosen_seeds(record: RunRecord) -> None:
    record.evaluations[-1].episodes.seed = [HELD_OUT_SEED + 1 + i for i in range(100)]


def chosen_seeds_on_the_way(record: RunRecord) -> None:
    record.evaluations[1].episodes.seed = [17, *record.evaluations[1].episodes.seed[1:]]


def half_the_budget(record: RunRecord) -> None:
    record.evaluations[-1].env_steps = record.budget.env_steps = 25_000


def wrong_budget(record: RunRecord) -> None:
    record.budget.env_steps += 8


def hundred_budgets(record: RunRecord) -> None:
    record.evaluations[-1].env_steps = record.budget.env_steps = 5_000_000


def another_agent(record: RunRecord) -> None:
    config = record.config | {"agent": "equivariant"}
    # Both at once: in between, the hash is wrong, which is refused.
    record.__dict__.update(config=config, config_hash=config_hash(config))


def another_seed(record: RunRecord) -> None:
    record.seeds["run"] = 77


def machine_path(record: RunRecord) -> None:
    record.base_policy.warning = "trained in /home/somebody/runs/base"


def windows_path(record: RunRecord) -> None:
    record.provenance.device = "C:\\Users\\somebody\\gpu"


@pytest.mark.parametrize(
    ("spoil", "sentence"),
    [
        (failed, r"the run is failed, not finished: continue it with `symsteer resume"),
        (interrupted, r"the run is interrupted, not finished"),
        (no_commit, r"the run names neither a commit nor a released version.*in a git clone"),
        (unreleased, r"the run names neither a commit nor a released version"),
        (loose_extension, r"the run used the agent mine:Mine, which belongs to no installed"),
        (local_changes, r"the run used code that is not in commit [0-9a-f]{12}: commit all"),
        (continued_with_changes, r"^part 3 of the run used code that is not in commit"),
        (continued_without_commit, r"^part 2 of the run names neither a commit nor"),
        (few_episodes, r"99 episodes, fewer than 100: run it again with --evaluation\.final"),
        (chosen_seeds, r"the evaluation at step 50000 is not on the held-out seeds 1000000, 100"),
        (chosen_seeds_on_the_way, r"the evaluation at step 25000 is not on the held-out seeds"),
        (half_the_budget, r"the run ended after 25000 of the 50000 environment steps"),
        (wrong_budget, r"stands at step 50000, but the run used 50008: run it again"),
        (hundred_budgets, r"the run used 5000000 environment steps, more than the 50000"),
        (another_agent, r"is named PickCube-v1-floating-none-standard-s2-.*-equivariant-s2: take"),
        (another_seed, r"the run drew from seed 77, but its configuration says 2: take"),
        (machine_path, r"/home/somebody/runs/base' holds a path of the machine: leave it out"),
        (windows_path, r"holds a path of the machine"),
    ],
)
def test_each_rule_alone(tmp_path: Path, spoil: Callable[[RunRecord], None], sentence: str) -> None:
    paths = five(tmp_path)
    record = admissible(seed=2)
    spoil(record)
    paths[2].unlink()
    store(record, tmp_path)
    verdicts = judge(*paths)
    assert sum(verdict.is_admissible for verdict in verdicts) == 4
    assert len(verdicts[2].problems) == 1
    assert re.search(sentence, verdicts[2].problems[0])


def test_every_rule_is_tested() -> None:
    """A new rule needs a line above."""
    assert len(RULES) == 7


def test_what_others_can_install_is_admitted_with_a_note(tmp_path: Path) -> None:
    record = admissible("base")
    record.provenance.commit = record.provenance.dirty = None
    record.provenance.sha256 = "cd" * 32
    record.provenance.extensions = [
        extension(name="mine", distribution="my-agents", version="1.2"),
        extension(kind="variant", name="fog", distribution="fogs", version="3.0"),
    ]
    verdict = judge(store(record, tmp_path))[0]
    assert verdict.is_admissible
    assert verdict.notes == [
        "it ran symsteer 0.1.0 as installed, not a checkout; sha256 cdcdcdcdcdcd",
        "it uses the agent mine of my-agents 1.2; sha256 abababababab",
        "it uses the variant fog of fogs 3.0; sha256 abababababab",
    ]


def edit(path: Path, **changes: Any) -> None:
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def test_a_file_under_another_name(tmp_path: Path) -> None:
    paths = five(tmp_path)
    moved = paths[0].rename(tmp_path / "record.json")
    verdict = judge(moved, *paths[1:])[0]
    assert verdict.problems == [
        "the file must be named after its run: rename it to "
        "PickCube-v1-floating-none-standard-s0-0123456789ab.json"
    ]


def test_damaged_files(tmp_path: Path) -> None:
    paths = five(tmp_path)
    edit(paths[0], config_hash="0" * 64)
    edit(paths[1], schema_version=99)
    paths[2].write_bytes(paths[2].read_bytes()[:-300])
    edit(paths[3], favourite="seed")
    verdicts = judge(*paths)
    sentences = ["config_hash does not belong", "schema_version '99'", "not strict JSON", "favour"]
    for verdict, sentence in zip(verdicts, sentences, strict=False):
        assert len(verdict.problems) == 1
        assert sentence in verdict.problems[0]
    assert verdicts[4].is_admissible
    assert verdicts[4].notes == [
        "shown, not ranked: its row has 1 of the 5 finished seeds that a ranking needs"
    ]


def test_references_need_no_budget_and_no_five_seeds(tmp_path: Path) -> None:
    record = admissible("zero")
    record.evaluations[0].env_steps = record.budget.env_steps = 0
    searched = admissible("golden-ticket")
    searched.evaluations[0].env_steps = searched.budget.env_steps = 12_800
    for verdict in judge(store(record, tmp_path), store(searched, tmp_path)):
        assert verdict.problems == []


def test_duplicates(tmp_path: Path) -> None:
    committed, new = tmp_path / "committed", tmp_path / "new"
    old = five(committed)
    copy = store(admissible(seed=1), new)
    again = admissible(seed=2)
    again.wall_clock.total += 1
    data = admissible(seed=3).model_dump(by_alias=True, exclude={"config_hash"})
    data["config"] |= {"seed": 8}
    data["seeds"]["run"] = 8
    renamed = RunRecord.model_validate(data | {"run_id": data["run_id"].replace("-s3-", "-s8-")})
    fresh = store(admissible(seed=9), new)
    verdicts = judge(copy, store(again, new), store(renamed, new), fresh, committed=committed)
    assert [verdict.problems for verdict in verdicts] == [
        [f"it is a copy of {old[1]}: remove one of the two"],
        [
            f"{old[2]} holds the same configuration, seeds and base policy already: remove one of "
            "the two (to replace a committed record, say why in the pull request)"
        ],
        [
            f"its evaluations equal those of {old[3]} to the last digit: a copy, or a setting that "
            "changes nothing; keep one of the two"
        ],
        [],
    ]
    assert verdicts[3].notes[-1] == (
        "its seed 9 is none of those of the committed runs of its table (0, 1, 2, 3, 4): agents "
        "are compared on equal seeds"
    )
    assert all(verdict.is_admissible for verdict in judge(*old, committed=committed))
    twice = judge(fresh, store(admissible(seed=9), new, "other.json"))
    assert [verdict.is_admissible for verdict in twice] == [True, False]
    assert twice[1].problems[1] == f"it is a copy of {fresh}: remove one of the two"


def test_two_learners_that_always_fail_are_no_copies(tmp_path: Path) -> None:
    paths = []
    for seed in range(2):
        record = admissible(seed=seed)
        for evaluation in record.evaluations:
            evaluation.episodes = make_evaluation([0] * 100, first_seed=HELD_OUT_SEED).episodes
            evaluation.diagnostics = {"q_mean": -20.0 - seed}
        paths.append(store(record, tmp_path))
    assert all(verdict.is_admissible for verdict in judge(*paths))


def test_another_base_policy_is_said(tmp_path: Path) -> None:
    committed, new = tmp_path / "committed", tmp_path / "new"
    five(committed)
    store(admissible("base"), committed)
    store(admissible("zero"), committed)

    def on_another_policy(agent: str, seed: int) -> Path:
        record = admissible(agent, seed)
        record.run_id += "-other"
        record.base_policy.content_hash = "ab" * 32
        return store(record, new)

    learner = on_another_policy("standard", 7)
    note = judge(learner, committed=committed)[0].notes[1]
    assert "base policy abababababab is not that of the committed runs" in note
    assert "submit base, zero on it" in note
    verdicts = judge(learner, on_another_policy("base", 0), committed=committed)
    assert "submit zero on it" in verdicts[0].notes[1]
    # The committed run of base with this seed is on another policy, so it is no twin.
    assert all("same configuration" not in problem for problem in verdicts[1].problems)
    # In a separate table there are no runs to compare with.
    elsewhere = store(admissible(task="PushCube-v1", seed=3), new, "elsewhere.json")
    assert not any("base policy" in n for n in judge(elsewhere, committed=committed)[0].notes)


def test_a_commit_that_nobody_has_is_said(tmp_path: Path) -> None:
    shallow = subprocess.run(
        ["git", "-C", str(REPOSITORY), "rev-parse", "--is-shallow-repository"],
        capture_output=True,
        text=True,
    )
    if shallow.stdout.strip() != "false":
        pytest.skip("needs a whole clone of the repository")
    record = admissible("base")
    record.provenance.commit = "0123456789" * 4
    verdict = judge(store(record, tmp_path))[0]
    assert verdict.is_admissible
    assert verdict.notes == [
        "its commit 012345678901 is not in this clone: push it with the pull request, so that "
        "others can run the same code"
    ]


def test_a_damaged_committed_record_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "committed").mkdir()
    (tmp_path / "committed" / "bad.json").write_text("{")
    path = store(admissible(), tmp_path)
    with pytest.raises(UserError, match=r"bad\.json is not strict JSON"):
        judge(path, committed=tmp_path / "committed")


# Command line


@pytest.fixture
def alone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Nothing is committed yet."""
    (tmp_path / "nothing").mkdir()
    monkeypatch.setattr(command, "RECORDS", tmp_path / "nothing")


@pytest.mark.usefixtures("alone")
def test_the_command_says_what_to_mend(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    paths = five(tmp_path / "new")
    assert main(["--check", *map(str, paths)]) == 0
    shown = capsys.readouterr()
    assert shown.err == ""
    assert shown.out.splitlines() == [
        *(f"{path}: admissible" for path in paths),
        "5 of 5 records are admissible",
    ]
    edit(paths[4], status="running", ended=None)
    (tmp_path / "new" / "hostile.json").write_text(
        '{"schema_version": 5, "config_hash": "", "\\u001b[2J\\nadmissible": 1}'
    )
    assert main(["--check", str(tmp_path / "new")]) == 2
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "4 of 6 records are admissible"
    assert sum(line.endswith(": NOT ADMISSIBLE") for line in lines) == 2
    assert sum(line.startswith("  problem: ") for line in lines) == 2
    assert all(line.isprintable() for line in lines)
    assert any("the run is running, not finished" in line for line in lines)


@pytest.mark.usefixtures("alone")
def test_of_many_records_the_command_names_those_it_complains_about(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = [store(admissible(seed=seed), tmp_path / "new") for seed in range(11)]
    assert main(["--check", str(tmp_path / "new")]) == 0
    assert capsys.readouterr().out == "11 of 11 records are admissible\n"
    edit(paths[4], status="running", ended=None)
    assert main(["--check", str(tmp_path / "new")]) == 2
    lines = capsys.readouterr().out.splitlines()
    assert [line for line in lines if ".json: " in line] == [f"{paths[4]}: NOT ADMISSIBLE"]
    assert lines[-1] == "10 of 11 records are admissible"


@pytest.mark.usefixtures("alone")
def test_the_command_refuses_two_things_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--check", "--verify"]) == 2
    assert "cannot be given together" in capsys.readouterr().err


@pytest.mark.long
def test_what_is_committed_is_admissible() -> None:
    verdicts = check([command.RECORDS], command.RECORDS)
    problems = [problem for verdict in verdicts for problem in verdict.problems]
    assert problems == []
