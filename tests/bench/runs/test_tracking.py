"""Runs in Weights & Biases: what its offline files hold, and that a run never depends on it."""

import json
import shutil
import struct
import sys
from importlib.machinery import PathFinder

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from symsteer.bench.cli import run, sweep
from symsteer.bench.runs.folder import run_id
from symsteer.bench.runs.tracking import check_tracking
from symsteer.bench.sweep.work import play
from symsteer.errors import UserError
from symsteer.leaderboard.records import read_record
from tests.bench.tiny_run import (
    execute,
    quiet,
    resume,
    stop,
    tiny_config,
    without_clock,
    write_suite,
)

pytestmark = pytest.mark.long

wandb = pytest.importorskip("wandb")

BLOCK = 32768
"""Bytes of a block of W&B's files, which are logs of LevelDB."""


@pytest.fixture(autouse=True)
def machine(monkeypatch, tmp_path_factory):
    """A machine on which W&B is offline and nobody is logged in."""
    home = str(tmp_path_factory.mktemp("home"))
    for name in ("WANDB_API_KEY", "WANDB_PROJECT"):
        monkeypatch.delenv(name, raising=False)
    for name in ("HOME", "WANDB_CONFIG_DIR", "WANDB_CACHE_DIR", "WANDB_DATA_DIR"):
        monkeypatch.setenv(name, home)
    monkeypatch.setenv("NETRC", f"{home}/.netrc")
    monkeypatch.setenv("WANDB_MODE", "offline")
    wandb.teardown()  # it reads the environment once
    yield
    wandb.teardown()


@pytest.fixture
def out(finished, tmp_path):
    """A folder for runs, with the base policy of the finished run."""
    shutil.copytree(finished[1].parent / "base", tmp_path / "base")
    return tmp_path


def records_of(path):
    """The protocol buffers in a file of W&B."""
    from wandb.proto.wandb_internal_pb2 import Record

    data, position, parts = path.read_bytes(), 7, b""
    while position + 7 <= len(data):
        if BLOCK - position % BLOCK < 7:
            position += BLOCK - position % BLOCK
            continue
        size, kind = struct.unpack_from("<HB", data, position + 4)
        parts += data[position + 7 : position + 7 + size]
        position += 7 + size
        if kind in (1, 4):  # a whole record, or the last part of one
            record, parts = Record(), parts
            record.ParseFromString(parts)
            parts = b""
            yield record


def read(folder):
    """What each process has written for a run: its facts, and its points by tag."""
    wandb.teardown()  # its service may still be writing when a run has finished
    found = []
    for path in sorted(folder.glob("wandb/offline-run-*/*.wandb")):
        points: dict[str, dict[int, float]] = {}
        for record in records_of(path):
            if record.WhichOneof("record_type") == "run":
                run = record.run
            if record.WhichOneof("record_type") == "history":
                row = {
                    "/".join(item.nested_key) or item.key: json.loads(item.value_json)
                    for item in record.history.item
                }
                for tag, value in row.items():
                    if not tag.startswith("_"):
                        points.setdefault(tag, {})[row["_step"]] = value
        found.append((run, points))
    return found


def config_of(run):
    return {item.key: json.loads(item.value_json) for item in run.config.update}


def scalars(folder):
    """The points that TensorBoard shows, by tag."""
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0})
    events.Reload()
    return {
        tag: {event.step: event.value for event in events.Scalars(tag)}
        for tag in events.Tags()["scalars"]
    }


def assert_mirrored(shown, folder):
    """W&B has TensorBoard's points, and one of each level line."""
    wanted = scalars(folder)
    assert set(wanted) <= set(shown)
    for tag, points in wanted.items():
        found = {step: float(value) for step, value in shown[tag].items()}
        if tag.startswith("reference/"):
            points = {0: points[0]}
        if tag.startswith("time/"):  # a continued run repeats steps, at other times
            assert found.keys() == points.keys()
        else:
            assert found == pytest.approx(points, rel=1e-6, nan_ok=True), tag


def test_a_tracked_run_has_the_same_record_and_its_scalars_are_in_wandb(finished, out, capsys):
    config, folder = finished
    tracked = execute(config, out, track="wandb", group="suite")
    assert without_clock(tracked) == without_clock(folder)
    assert tracked.name == folder.name
    [(run, points)] = read(tracked)
    record = read_record(tracked / "record.json")
    assert (run.project, run.run_group, run.display_name) == ("symsteer", "suite", record.run_id)
    assert run.job_type == "learner"
    assert config_of(run)["agent_options"] == record.config["agent_options"]
    assert config_of(run)["commit"] == record.provenance.commit
    assert_mirrored(points, tracked)
    assert points["eval/paths/_type"] == {record.budget.env_steps: "image-file"}
    assert f"wandb sync {tracked}" in capsys.readouterr().out.replace("\n", "")


def test_a_continued_run_goes_on_in_wandb_without_points_twice(out):
    config = tiny_config(env_steps=480, checkpoint_every=60)
    folder = stop(config, out, 320, track="wandb", group="suite")
    assert resume(folder, track="wandb") == folder
    (first, before), (second, after) = read(folder)
    assert first.run_id == second.run_id
    assert first.run_group == second.run_group == "suite"
    for tag in before:
        assert max(before[tag]) < min(after.get(tag, [10**9])), tag
    assert_mirrored(
        {tag: before.get(tag, {}) | after.get(tag, {}) for tag in before | after}, folder
    )


def test_runs_of_one_process_are_runs_of_their_own_in_wandb(out):
    configs = tuple(tiny_config(agent=agent) for agent in ("zero", "base"))
    assert play(configs, quiet(out=out, track="wandb", group="suite"), 0).status == "done"
    ids = set()
    for config in configs:
        folder = out / run_id(config, {})
        [(run, points)] = read(folder)
        ids.add(run.run_id)
        assert run.display_name == folder.name
        assert_mirrored(points, folder)
        assert list(points["eval/paths/_type"].values()) == ["image-file"]
    assert len(ids) == 2


@pytest.mark.slow
def test_a_sweep_tracks_its_runs_as_a_group(out):
    config = tiny_config(agent="zero")
    assert sweep(write_suite(out, config, "seed = [0]"), out=out, workers=1, track="wandb") == 0
    folder = out / run_id(config, {})
    [(run, points)] = read(folder)
    assert (run.run_group, run.job_type) == ("tiny", "reference")
    assert_mirrored(points, folder)


@pytest.mark.parametrize("method", ["init", "log", "finish"])
def test_a_run_does_not_end_with_the_tracking(method, out, monkeypatch, capsys):
    def fail(*args, **options):
        raise wandb.errors.CommError("the network\nis down")

    monkeypatch.setattr(wandb if method == "init" else wandb.Run, method, fail)
    if method != "finish":
        monkeypatch.setattr(wandb, "Image", fail)  # is not even asked for
    folder = execute(tiny_config("zero"), out, track="wandb")
    assert read_record(folder / "record.json").status == "finished"
    assert scalars(folder)
    said = [line for line in capsys.readouterr().out.splitlines() if "goes on" in line]
    assert said == [f"{folder.name} goes on without Weights & Biases: the network is down"]


def test_a_damaged_state_begins_a_new_run_in_wandb(out):
    folder = stop(tiny_config("zero"), out, 0, track="wandb")
    (folder / "wandb.json").write_text('{"id": 3}')
    resume(folder, track="wandb")
    (first, _), (second, points) = read(folder)
    assert first.run_id != second.run_id
    assert_mirrored(points, folder)


def test_mistakes_are_told_before_anything_is_built(monkeypatch, tmp_path):
    check_tracking(None)

    def refused():
        with pytest.raises(UserError) as error:
            run(["--out", str(tmp_path / "runs"), "--track", "wandb"])
        assert not (tmp_path / "runs").exists()
        return str(error.value)

    monkeypatch.setenv("WANDB_MODE", "online")
    wandb.teardown()
    cure = "run `wandb login`, set WANDB_MODE=offline to upload later, or leave --track out"
    wanted = "--track wandb cannot log in to Weights & Biases (no API key was found); "
    assert refused() == wanted + cure
    monkeypatch.setenv("WANDB_API_KEY", "short")
    assert "API key must have 40+ characters" in refused()
    monkeypatch.setenv("WANDB_MODE", "sometimes")
    wandb.teardown()
    assert "(1 validation error for Settings mode Input should be 'online'" in refused()
    # A folder that W&B has made can be imported as an empty package.
    monkeypatch.delitem(sys.modules, "wandb")
    monkeypatch.setattr(sys, "path", [str(tmp_path)])
    monkeypatch.setattr(sys, "meta_path", [PathFinder])
    (tmp_path / "wandb").mkdir()
    assert 'install it with: pip install "symsteer[wandb]"' in refused()
