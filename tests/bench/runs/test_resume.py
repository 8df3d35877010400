"""A run that is killed and continued has the same record as one that was not stopped."""

import dataclasses
import functools
import hashlib
import io
import json
import multiprocessing
import operator
import re
import shutil
import zipfile

import pytest
import torch

from symsteer.bench.runs.checkpoint import CHECKSUM_BYTES, load_checkpoint
from symsteer.bench.runs.folder import (
    CHECKPOINT,
    RunBusyError,
    claimed,
    is_finished,
    read_progress,
    state_of,
)
from symsteer.bench.runs.run import evaluate
from symsteer.errors import UserError
from symsteer.leaderboard.records import DERIVED, read_record, run_id_of
from symsteer.leaderboard.records.retired import RETIRED
from tests.bench.runs.conftest import ensure
from tests.bench.tiny_run import resume, stop, tiny_config, without_clock

# Processes that have finished their imports: the kill then happens during the run.
PROCESSES = multiprocessing.get_context("forkserver")
PROCESSES.set_forkserver_preload(["tests.bench.runs.test_resume", "torch._dynamo"])

# Fractions of an update are carried over to the next decision.
CONFIG = tiny_config(
    env_steps=400,
    checkpoint_every=60,
    evaluation=dataclasses.replace(tiny_config().evaluation, every=320),
    # The world changes in the course of the run.
    variant="action_gain:1@0.2..0.6+perception_bias:0..1",
    # After the first checkpoint some noise is still drawn at random.
    options={"utd": 0.3, "warmup": 40},
)


@pytest.fixture(scope="module")
def undisturbed(shared):
    ensure(tiny_config(), shared)  # with the base policy of both
    return ensure(CONFIG, shared)


@pytest.fixture
def begun(undisturbed, tmp_path):
    """The folder of a run that was stopped before it had done anything."""
    shutil.copytree(undisturbed.parent / "base", tmp_path / "base")
    folder = tmp_path / undisturbed.name
    folder.mkdir()
    shutil.copy(undisturbed / "config.json", folder)
    return folder


@pytest.mark.long
def test_killed_behind_every_checkpoint(undisturbed, begun):
    kills, seen = 0, None
    while not is_finished(begun):
        process = PROCESSES.Process(target=resume, args=(begun,), daemon=True)
        process.start()
        while process.is_alive() and seen == (seen := _version(begun / CHECKPOINT)):
            process.join(0.005)
        if process.is_alive():
            process.kill()
            kills += 1
        process.join()
        # A checkpoint that was written after the last check.
        seen = _version(begun / CHECKPOINT)
    assert kills >= 2
    assert without_clock(begun) == without_clock(undisturbed)


def _version(path):
    return path.stat().st_mtime_ns if path.exists() else None


def test_evaluating_again_gives_the_recorded_episodes(undisturbed):
    before = {path.name: path.stat().st_mtime_ns for path in undisturbed.iterdir()}
    found, final = evaluate(undisturbed), read_record(undisturbed / "record.json").final
    assert found.recorded is True
    assert found.evaluation.episodes == final.episodes
    assert found.evaluation.diagnostics == final.diagnostics
    elsewhere = evaluate(undisturbed, variant="action_gain:1", episodes=2)
    assert (elsewhere.variant, elsewhere.recorded) == ("action_gain:1", None)
    assert elsewhere.evaluation.episodes.seed == final.episodes.seed[:2]
    assert json.loads(json.dumps(elsewhere.to_json()))["episodes"]["episode_len"] == [50] * 2
    assert {path.name: path.stat().st_mtime_ns for path in undisturbed.iterdir()} == before


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"variant": "action_gian:1"}, "action_gain"),
        ({"episodes": 0}, "--episodes is 0"),
        ({"workers": 0}, "--sim-workers is 0"),
    ],
)
def test_mistakes_in_evaluating_again(arguments, words, undisturbed):
    with pytest.raises(UserError, match=words):
        evaluate(undisturbed, **arguments)


def test_a_run_is_worked_on_by_one_process(undisturbed, begun):
    with claimed(begun):
        assert state_of(begun) == "running"
        with pytest.raises(RunBusyError, match="another process"):
            resume(begun)
    assert state_of(begun) == "interrupted"


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (lambda data: data.update(sac=data.pop("agent_options")), r"a run of SymSteer 0\.1"),
        (
            lambda data: data["policy"].pop("zero_output"),
            r"older version, without policy\.zero_output; use that",
        ),
        (lambda data: data.update(keep_replay=True), "no key 'keep_replay'"),
    ],
)
def test_a_run_of_another_version_is_named(edit, words, begun):
    data = json.loads((begun / "config.json").read_text())
    edit(data)
    (begun / "config.json").write_text(json.dumps(data))
    with pytest.raises(UserError, match=words):
        resume(begun)


def test_a_run_with_an_option_that_is_no_more_goes_on(begun, monkeypatch):
    monkeypatch.setitem(RETIRED, "momentum", 0.0)
    data = json.loads((begun / "config.json").read_text())
    data["agent_options"]["momentum"] = 0.0
    data["keep_replay"] = False
    own = {key: value for key, value in data.items() if key not in DERIVED}
    folder = begun.with_name(run_id_of({**own, "files": {}}))
    begun.rename(folder)
    (folder / "config.json").write_text(json.dumps(data))
    resume(folder)
    assert read_record(folder / "record.json").config == data
    assert evaluate(folder).recorded


def test_what_cannot_be_continued(undisturbed, begun, tmp_path):
    with pytest.raises(UserError, match="finished already"):
        resume(undisturbed)
    with pytest.raises(UserError, match=r"no config\.json"):
        resume(tmp_path / "nothing")
    with pytest.raises(UserError, match="no checkpoint yet"):
        evaluate(begun)
    renamed = begun.rename(tmp_path / "renamed")
    with pytest.raises(UserError, match="does not belong"):
        resume(renamed)
    state = load_checkpoint(undisturbed)
    assert (state["final"], state["replay"]) == (True, None)
    progress = read_progress(undisturbed)
    assert (progress["phase"], progress["budget"]) == ("evaluation", CONFIG.env_steps)


def test_a_damaged_or_foreign_checkpoint_is_refused_and_kept(undisturbed, begun):
    shutil.copy(undisturbed / "policy.safetensors", begun)
    whole = (undisturbed / "checkpoint.pt").read_bytes()
    content = torch.load(io.BytesIO(whole[:-CHECKSUM_BYTES]), weights_only=True)
    for words, change in (("another run", {"run_id": "else"}), ("version", {"format": 99})):
        archive = io.BytesIO()
        torch.save({**content, **change}, archive)
        checksum = hashlib.sha256(archive.getvalue()).digest()
        (begun / "checkpoint.pt").write_bytes(archive.getvalue() + checksum)
        with pytest.raises(UserError, match=words):
            resume(begun)
    (begun / "checkpoint.pt").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UserError, match="delete it"):
        resume(begun)
    assert (begun / "checkpoint.pt").stat().st_size == len(whole) // 2


@pytest.fixture(scope="module")
def stopped(undisturbed, tmp_path_factory):
    """The folder of a run that was stopped after its first checkpoint, with its checkpoint."""
    out = tmp_path_factory.mktemp("stopped")
    shutil.copytree(undisturbed.parent / "base", out / "base")
    folder = stop(CONFIG, out, env_steps=320)
    archive = (folder / "checkpoint.pt").read_bytes()[:-CHECKSUM_BYTES]
    return folder, archive


def sealed(path, content, cut=0):
    """Write a checkpoint with the right checksum; ``cut`` bytes are missing in its first tensor."""
    buffer = io.BytesIO()
    torch.save(content, buffer)
    if cut:
        whole, buffer = zipfile.ZipFile(buffer), io.BytesIO()
        with zipfile.ZipFile(buffer, "w") as archive:
            for name in whole.namelist():
                data = whole.read(name)
                archive.writestr(name, data[:-cut] if name.endswith("data/0") else data)
    path.write_bytes(buffer.getvalue() + hashlib.sha256(buffer.getvalue()).digest())


@pytest.mark.parametrize(
    ("place", "value", "words"),
    [
        ("env_steps", -1, "env_steps: Input should be greater than or equal to 0"),
        ("recent_episodes", {"a": ["b"]}, "recent_episodes.a.0: Input should be a valid number"),
        ("seconds total", float("nan"), "seconds.total: Input should be a finite number"),
        ("agent", {}, "this checkpoint has agent None"),
        ("agent owed", 1e300, "updates are due"),
        ("agent generator", torch.zeros(3, dtype=torch.uint8), "the state of a generator has the"),
        ("agent networks critic", {}, "Missing key(s)"),
        ("agent optimizers critic state 0 exp_avg", torch.zeros(1), "has the shape"),
        ("replay position", 10**6, "the saved replay holds"),
        ("replay rows reward", torch.zeros(1).expand(10**10), "the saved replay holds"),
    ],
)
def test_a_checkpoint_of_another_form_is_refused(stopped, place, value, words):
    """Its checksum is right."""
    folder, archive = stopped
    path, content = folder / "checkpoint.pt", torch.load(io.BytesIO(archive), weights_only=True)
    *keys, last = (int(key) if key.isdigit() else key for key in place.split())
    functools.reduce(operator.getitem, keys, content["state"])[last] = value
    sealed(path, content)
    with pytest.raises(UserError, match=re.escape(words)) as error:
        resume(folder)
    assert str(path) in str(error.value)
    assert "delete it to start the run from the beginning" in str(error.value)


def test_a_tensor_that_is_shorter_than_it_says_is_not_read(stopped):
    folder, archive = stopped
    path, content = folder / "checkpoint.pt", torch.load(io.BytesIO(archive), weights_only=True)
    sealed(path, content)
    assert load_checkpoint(folder)
    sealed(path, content, cut=4)
    with pytest.raises(UserError, match="cannot be read as a checkpoint"):
        load_checkpoint(folder)
