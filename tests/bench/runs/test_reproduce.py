"""`symsteer reproduce`: a tiny run is really repeated; a record that was changed does not agree."""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from pathlib import Path

import pytest

from symsteer.bench.runs.reproduce import conditions, reproduce
from symsteer.leaderboard.records import (
    config_hash,
    dump_record,
    file_hash,
    read_record,
    read_reproductions,
)
from symsteer.leaderboard.runs import load_runs
from tests.bench.tiny_run import execute, quiet, tiny_config, without_clock


@pytest.fixture(scope="module")
def repeated(finished, tmp_path_factory) -> tuple[Path, Path]:
    """The folder of a finished run, and that in which it was made again."""
    out = tmp_path_factory.mktemp("again")
    done = reproduce(finished[1], out, quiet())
    assert done.run.parent.parent == out
    return finished[1], done.run


@pytest.fixture
def changed(finished, tmp_path):
    """Changes a copy of the record; its reproduction is the run as it was."""
    folder = finished[1]

    def change(edit) -> Path:
        data = json.loads((folder / "record.json").read_text())
        edit(data)
        path = tmp_path / "record.json"
        path.write_text(json.dumps(data))
        place = tmp_path / "out" / f"reproduction-{file_hash(path)[:12]}"
        shutil.copytree(folder, place / folder.name)
        return path

    return change


@pytest.mark.long
def test_a_run_is_made_again_and_agrees_exactly(repeated, tmp_path, command):
    folder, again = repeated
    assert without_clock(folder) == without_clock(again)
    record = folder / "record.json"
    assert record.read_bytes() != (again / "record.json").read_bytes()
    assert any((again.parent / "base").iterdir()), "the base policy was not made anew"
    marks = tmp_path / "marks"
    # The same command finds the finished run in its place.
    code, shown = command("reproduce", folder, "--out", again.parent.parent, "--into", marks)
    assert code == 0
    assert "compared without making it again" in shown.err
    assert "Everything agrees exactly." in shown.out
    digest = hashlib.sha256(record.read_bytes()).hexdigest()
    names = [f"{digest}{end}" for end in (".json", ".record.json", ".sha256")]
    assert sorted(path.name for path in marks.iterdir()) == names
    assert (marks / names[1]).read_bytes() == (again / "record.json").read_bytes()
    line = f"{file_hash(marks / names[0])}  marks/{names[0]}\n"
    assert (marks / names[2]).read_text() == line
    (run,) = load_runs([record], marks)
    assert run.reproduction is not None
    assert (marks / f"{digest}.json").read_bytes() == (
        again.parent / "reproduction.json"
    ).read_bytes()
    found = read_reproductions(marks)[digest]
    assert (found.verdict, found.differences) == ("exact", [])
    assert found.record.run_id == folder.name
    assert found.repeated.sha256 == file_hash(again / "record.json")
    assert str(tmp_path.parent) not in (marks / f"{digest}.json").read_text()


def flip(data):
    episodes = data["evaluations"][0]["episodes"]
    episodes["success_once"][2] ^= 1
    episodes["success_at_end"][2] = 0


def flip_in_an_older_torch(data):
    flip(data)
    data["provenance"]["packages"] |= {"torch": "1.0+cpu", "sapien": "2.0"}


def succeed(data):
    episodes = data["evaluations"][-1]["episodes"]
    before, count = sum(episodes["success_once"]), len(episodes["success_once"])
    episodes["success_once"] = [int(before < 2)] * count
    episodes["success_at_end"] = [0] * count


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (
            flip,
            (
                r"^episodes +1 of \d+ +\d+ steps .*success_once\.2",
                "exactly  seeds, parameters, base policy, feasible Q, budget, diagnostics$",
                "does not differ clearly",
            ),
        ),
        (
            flip_in_an_older_torch,
            (
                r"Versions may explain it: sapien 2\.0 -> .*, torch 1\.0\+cpu -> \d",
                r"the record: pip install sapien==2\.0 torch==1\.0$",
            ),
        ),
        (
            lambda data: data["seeds"].update(agent=12345),
            ("No version of a package explains that seeds differ",),
        ),
        (succeed, ("the final success differs", r", 0\.000 here \(-1\.000 \[")),
    ],
)
def test_episodes_that_were_changed_are_found(edit, words, changed, tmp_path, command):
    code, shown = command("reproduce", changed(edit), "--out", tmp_path / "out")
    assert code == 1
    for text in words:
        assert re.search(text, shown.out, re.MULTILINE), text


def test_files_that_the_run_began_from_are_checked(finished, tmp_path, command):
    folder = finished[1]
    policy = folder / "policy.safetensors"
    run = execute(tiny_config(agent="zero"), tmp_path / "runs", base_policy=policy)
    other = tmp_path / "other.safetensors"
    other.write_bytes(policy.read_bytes() + b"\0")
    for arguments, words in (
        ((run,), "began from a policy file .* --base-policy FILE.safetensors"),
        ((run, "--base-policy", other), "has the hash"),
        ((run, "--base-policy", policy, "--base-from", tmp_path), "leave --base-from out"),
        ((folder, "--demos", policy), "began from no demonstrations file; leave --demos out"),
    ):
        code, shown = command("reproduce", *arguments)
        assert code == 2
        assert re.search(words, shown.err)
    code, shown = command("reproduce", run, "--base-policy", policy, "--out", tmp_path / "out")
    assert code == 0


def test_of_submitted_records_one_is_drawn(changed, tmp_path, command, monkeypatch):
    path = changed(lambda data: data.update(run_id="first"))
    folder = tmp_path / "submitted"
    folder.mkdir()
    path = path.rename(folder / "first.json")
    for name in ("second.json", "third.json", "repeated.record.json"):
        (folder / name).write_text("{}")
    offered = []
    monkeypatch.setattr("secrets.choice", lambda found: offered.extend(found) or found[0])
    code, shown = command("reproduce", folder, "--out", tmp_path / "out")
    assert code == 0
    assert "drawn at random from 3 records: first.json" in shown.err
    assert [one.name for one in offered] == ["first.json", "second.json", "third.json"]


def test_the_base_policy_of_other_runs_is_taken(finished, tmp_path, command):
    folder = finished[1]
    # An older version with fewer options gave another name to the same policy.
    runs, name = tmp_path / "older", "PickCube-v1-floating-edp-older"
    shutil.copytree(folder.parent / "base", runs / "base")
    (policy,) = (runs / "base").glob("*/policy.safetensors")
    policy.parent.rename(runs / "base" / name)
    policy = runs / "base" / name / policy.name
    arguments = (folder, "--out", tmp_path / "out", "--base-from")
    code, shown = command("reproduce", *arguments, tmp_path / "nowhere")
    assert code == 2
    assert "does not have the base policy" in shown.err
    other = json.loads((folder / "record.json").read_text())
    other["base_policy"]["content_hash"] = "ab" * 32
    (tmp_path / "other.json").write_text(json.dumps(other))
    code, shown = command("reproduce", tmp_path / "other.json", *arguments[1:], runs)
    assert code == 2
    assert "does not have the base policy abababababab" in shown.err
    assert not (tmp_path / "out").exists()
    code, shown = command("reproduce", *arguments, runs)
    assert code == 0
    assert "are those of other runs, not made anew" in shown.out
    (place,) = (tmp_path / "out").iterdir()
    assert place.name.endswith("-taken")
    # Training again would give the same policy, but not the same time in its file.
    (copy,) = (place / "base").glob("*/policy.safetensors")
    assert copy.read_bytes() == policy.read_bytes()


def test_what_cannot_be_repeated_is_one_sentence(finished, tmp_path, command):
    folder = finished[1]
    record = read_record(folder / "record.json")

    def refused(**changes) -> str:
        copy = record.model_copy(update=changes)
        copy.__dict__["config_hash"] = config_hash(copy.config)
        path = tmp_path / "record.json"
        path.write_text(dump_record(copy))
        code, shown = command("reproduce", path, "--out", tmp_path / "out")
        assert (code, shown.out) == (2, "")
        assert shown.err.startswith("error: ")
        assert shown.err.count("\n") == 1
        return shown.err

    assert "running, not finished" in refused(status="running", ended=None)
    gone = refused(config=record.config | {"agent": "approximate", "agent_options": {}})
    assert "cannot repeat" in gone
    assert "there is no agent 'approximate'" in gone
    assert f"commit {record.provenance.commit[:12]}: use that" in gone
    assert "SymSteer 0.1" in refused(config=record.config | {"sac": {"width": 3}})
    many = refused(config=record.config | {"num_envs": 500, "env_steps": 10**6})
    assert "PhysX scenes" in many
    strange = {**record.config, "files": {"weights": "0" * 64}}
    assert "files of a kind" in refused(config=strange)
    unfinished = tmp_path / "unfinished"
    unfinished.mkdir()
    (unfinished / "config.json").write_text("{}")
    for path in (tmp_path / "nowhere", tmp_path.parent, unfinished):
        code, shown = command("reproduce", path)
        assert code == 2
        assert "record.json" in shown.err or "nowhere" in shown.err
    assert not (tmp_path / "out").exists()


def test_other_circumstances_are_named(finished):
    record, config = read_record(finished[1] / "record.json"), tiny_config()
    clean = record.provenance.model_copy(update={"dirty": False, "processor": "One"})
    record.provenance = clean
    here = clean.model_copy()
    assert conditions(record, config, here) == []
    packages = clean.packages | {"numpy": "1.0"}
    elsewhere = clean.model_copy(
        update={
            "commit": "f" * 40,
            "packages": packages,
            "platform": "Linux riscv64",
            "processor": "Another (family 1, model 2)",
            "torch_threads": 7,
            "dirty": True,
        }
    )
    text = "\n".join(conditions(record, config, elsewhere))
    for words in ("commit ffffffffffff", "numpy was", "Linux riscv64", "OMP_NUM_THREADS", "local"):
        assert words in text
    assert "the processor was One, and is Another (family 1, model 2) here" in text
    older_record = record.model_copy(
        update={"provenance": clean.model_copy(update={"processor": None})}
    )
    assert "processor" not in "\n".join(conditions(older_record, config, elsewhere))
    team = record.model_copy(update={"provenance": clean.model_copy(update={"together": 5})})
    assert "together with 4 others" in "\n".join(conditions(team, config, here))
    older = dict(record.config)
    del older["checkpoint_every"]
    record.__dict__["config"] = older
    assert conditions(record, config, here) == [
        "options that are newer than the record have defaults: checkpoint_every"
    ]
