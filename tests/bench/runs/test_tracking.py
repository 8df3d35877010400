"""Runs in Weights & Biases: what is logged there, and that a run never depends on it."""

import json
import shutil
import sys
from importlib.machinery import PathFinder
from types import SimpleNamespace

import numpy as np
import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from symsteer.bench.cli import run
from symsteer.bench.runs.folder import run_id
from symsteer.bench.runs.together import execute_together
from symsteer.bench.runs.tracking import WandbLog, check_tracking
from symsteer.errors import UserError
from symsteer.leaderboard.records import read_record
from tests.bench.tiny_run import (
    quiet,
    resume,
    stop,
    tiny_config,
    without_clock,
)

pytestmark = pytest.mark.long

wandb = pytest.importorskip("wandb", exc_type=ImportError)


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


@pytest.fixture
def begun(monkeypatch):
    """What is logged, in place of W&B: for each of its runs the options, points, and exit code."""
    runs = []

    def init(**options):
        run = SimpleNamespace(
            options=options, points={}, code=None, offline=False, url="there", dir="here"
        )

        def log(values, step):
            for tag, value in values.items():
                run.points.setdefault(tag, {})[step] = value

        run.log, run.finish = log, lambda exit_code: setattr(run, "code", exit_code)
        runs.append(run)
        return run

    monkeypatch.setattr(wandb, "init", init)
    return runs


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
    assert set(shown) == {*wanted, "eval/paths"}
    for tag, points in wanted.items():
        if tag.startswith("reference/"):
            points = {0: points[0]}
        if tag.startswith("time/"):  # a continued run repeats steps, at other times
            assert shown[tag].keys() == points.keys()
        else:
            assert shown[tag] == pytest.approx(points, rel=1e-6, nan_ok=True), tag


def test_a_tracked_run_has_the_same_record_and_wandb_has_its_points(finished, out, capsys):
    """Also beside another run in one process."""
    config, folder = finished
    other = tiny_config("zero")
    how = quiet(runs=out, track=True, group="suite")
    assert execute_together([config, other], how) == [None, None]
    wandb.teardown()  # its service may still be writing when a run has finished
    tracked = out / folder.name
    assert without_clock(tracked) == without_clock(folder)
    [beside] = (out / run_id(other, {})).glob("wandb/offline-run-*/*.wandb")
    assert run_id(other, {}).encode() in beside.read_bytes()
    [file] = tracked.glob("wandb/offline-run-*/*.wandb")
    content = file.read_bytes()
    for text in (tracked.name, "symsteer", "suite", "learner", "losses/critic", "commit"):
        assert text.encode() in content
    assert list(file.parent.glob("files/media/images/eval/paths*.png"))
    assert f"wandb sync {tracked}" in capsys.readouterr().out.replace("\n", "")


def test_a_continued_run_goes_on_in_wandb_without_points_twice(out, begun):
    config = tiny_config(env_steps=320, checkpoint_every=60)
    folder = stop(config, out, 160, track="wandb", group="suite")
    assert resume(folder, track="wandb") == folder
    first, second = begun
    for key in ("id", "group", "name"):
        assert first.options[key] == second.options[key]
    assert (first.options["group"], first.options["project"]) == ("suite", "symsteer")
    assert (first.code, second.code) == (1, 0)
    for tag in first.points:
        assert max(first.points[tag]) < min(second.points.get(tag, [10**9])), tag
    tags = first.points | second.points
    both = {tag: first.points.get(tag, {}) | second.points.get(tag, {}) for tag in tags}
    assert_mirrored(both, folder)


@pytest.mark.parametrize("method", ["init", "log", "finish"])
def test_an_error_of_the_tracking_is_told_once_and_ends_nothing(
    method, finished, begun, tmp_path, monkeypatch, capsys
):
    def fail(*args, **options):
        raise wandb.errors.CommError("the network\nis down")

    init = wandb.init

    def begin(**options):
        run = init(**options)
        setattr(run, method, fail)
        return run

    record = read_record(finished[1] / "record.json")
    monkeypatch.setattr(wandb, "init", fail if method == "init" else begin)
    # A damaged state begins a new run there.
    (tmp_path / "wandb.json").write_text('{"id": 3}')
    log = WandbLog(tmp_path, record, None)
    log.scalars({"eval/success_once": 0.5}, 0)
    log.picture("eval/paths", np.zeros((2, 2, 3), np.uint8), 0)
    log.end(finished=True)
    said = [line for line in capsys.readouterr().out.splitlines() if "goes on" in line]
    assert said == [f"{tmp_path.name} goes on without Weights & Biases: the network is down"]
    assert json.loads((tmp_path / "wandb.json").read_text())["id"] != 3


def test_mistakes_are_told_before_anything_is_built(monkeypatch, tmp_path):
    check_tracking(None)

    def refused():
        with pytest.raises(UserError) as error:
            run(["--runs", str(tmp_path / "runs"), "--track"])
        assert not (tmp_path / "runs").exists()
        return str(error.value)

    monkeypatch.setenv("WANDB_MODE", "online")
    wandb.teardown()
    cure = "run `wandb login`, set WANDB_MODE=offline to upload later, or leave --track out"
    wanted = "--track cannot log in to Weights & Biases (no API key was found); "
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
