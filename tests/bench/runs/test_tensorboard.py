"""What TensorBoard shows of a run, read back with TensorBoard's own loader."""

import errno
import io
import os
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar import layout_pb2
from tensorboard.plugins.hparams import api_pb2, metadata

from symsteer.bench.runs import observers
from symsteer.bench.runs.folder import run_id, state_of
from symsteer.bench.runs.run import execute, resume
from symsteer.bench.runs.tensorboard import FINAL_METRICS, IDENTITY, RunLog
from symsteer.bench.runs.trainer import Trainer
from symsteer.bench.sim.headless import rendering_works
from symsteer.errors import UserError
from symsteer.leaderboard.records import read_record
from tests.bench.tiny_run import tiny_config

DOCUMENTATION = Path(__file__).parents[3] / "docs" / "metrics.md"
NAMESPACES = {"eval", "train", "losses", "time", "diag", "limits"}
CORRELATIONS = {f"diag/q_{kind}correlation" for kind in ("", "rank_", "off_", "off_rank_")}
"""Not measured in tiny runs: all of their episodes fail, so that returns have no variance."""


def load(folder):
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0, "images": 0, "tensors": 0})
    events.Reload()
    return events


def scalar_tags(folder):
    return set(load(folder).Tags()["scalars"])


def documented_tags():
    """Names in the first column of the tables under headings that name a namespace."""
    tags, namespaces = set(), []
    for line in DOCUMENTATION.read_text().splitlines():
        if line.startswith("#"):
            namespaces = re.findall(r"`(\w+)/`", line.partition("TensorBoard")[2])
        elif line.startswith("| `"):
            names = re.findall(r"`(\w+)`", line.split("|")[1])
            tags |= {f"{namespace}/{name}" for namespace in namespaces for name in names}
    return tags


@pytest.fixture(scope="module")
def continued(finished):
    """A run that was stopped after an evaluation that is in no checkpoint, and continued."""
    _, folder = finished
    evaluate = Trainer.evaluate

    def evaluate_and_stop(self, final=False):
        evaluate(self, final)
        if self.env_steps >= 320:
            raise RuntimeError("stopped")

    config = tiny_config(env_steps=480, checkpoint_every=60)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Trainer, "evaluate", evaluate_and_stop)
        with pytest.raises(RuntimeError, match="stopped"):
            execute(config, folder.parent, progress=False)
    stopped = folder.parent / run_id(config, {})
    assert state_of(stopped) == "failed"
    written = load(stopped).Scalars("eval/success_once")[-1].step
    assert resume(stopped, progress=False) == stopped
    return stopped, written


def test_every_tag_is_documented_and_every_documented_tag_written(broken):
    written = set().union(*map(scalar_tags, broken.values()))
    assert not written & CORRELATIONS
    assert written | CORRELATIONS == documented_tags()
    assert {tag.partition("/")[0] for tag in written} == NAMESPACES


def assert_equals_record(folder):
    """Points of eval/ and diag/ are the record's evaluations: all of them, once, no others."""
    events, record = load(folder), read_record(folder / "record.json")
    wanted: dict[str, list[tuple[int, float]]] = {}
    for evaluation in record.evaluations:
        episodes = evaluation.episodes.model_dump(by_alias=True)
        values = {
            f"eval/{name}": sum(column) / len(column)
            for name, column in episodes.items()
            if name not in ("seed", "nonfinite")
        }
        for name, value in evaluation.diagnostics.items():
            kind = evaluation.nonfinite.get(f"diagnostics/{name}")
            if value is not None or kind is not None:
                values[f"diag/{name}"] = float(kind) if value is None else value
        for tag, value in values.items():
            wanted.setdefault(tag, []).append((evaluation.env_steps, value))
    tags = {tag for tag in events.Tags()["scalars"] if tag.startswith(("eval/", "diag/"))}
    assert tags == set(wanted)
    for tag, points in wanted.items():
        found = [(point.step, point.value) for point in events.Scalars(tag)]
        assert [step for step, _ in found] == [step for step, _ in points]
        for (_, shown), (_, stored) in zip(found, points, strict=True):
            assert shown == pytest.approx(stored, rel=1e-6, nan_ok=True)


def test_evaluations_are_those_of_the_record(broken):
    for folder in broken.values():
        assert_equals_record(folder)


def test_a_continued_run_shows_every_point_once(continued):
    folder, written = continued
    steps = [e.env_steps for e in read_record(folder / "record.json").evaluations]
    # The stopped process had written an evaluation that was repeated.
    assert written in steps[:-1]
    assert len(list(folder.glob("events.*"))) == 2
    assert_equals_record(folder)
    events = load(folder)
    for tag in events.Tags()["scalars"]:
        points = [point.step for point in events.Scalars(tag)]
        assert points == sorted(set(points)), tag


def test_the_charts_show_tags_that_exist(broken):
    tags = scalar_tags(broken["equivariant"]) | CORRELATIONS
    [event] = load(broken["equivariant"]).Tensors("custom_scalars__config__")
    layout = layout_pb2.Layout.FromString(event.tensor_proto.string_val[0])
    charts = {chart.title: chart for category in layout.category for chart in category.chart}
    for chart in charts.values():
        for pattern in chart.multiline.tag:
            assert any(re.search(pattern, tag) for tag in tags), pattern
    [margin] = charts["Q against its feasible band"].margin.series
    shown = [margin.value, margin.lower, margin.upper]
    assert shown == ["diag/q_mean", "diag/q_low", "diag/q_high"]
    assert set(shown) <= tags
    [errors] = charts["Equivariance errors"].multiline.tag
    assert sum(bool(re.search(errors, tag)) for tag in tags) == 3


def test_hyperparameters_can_be_compared_across_runs(broken):
    experiments = []
    for name, folder in broken.items():
        events = load(folder)

        def content(tag, events=events):
            return events.SummaryMetadata(tag).plugin_data.content

        record = read_record(folder / "record.json")
        start = metadata.parse_session_start_info_plugin_data(
            content(metadata.SESSION_START_INFO_TAG)
        )
        values = start.hparams
        assert values["agent"].string_value == name
        own = record.config["agent_options"]
        for key in ("lr", "penalty", "candidates"):
            if key in own:
                assert values[f"agent_options.{key}"].number_value == own[key]
        assert values["demonstrations.count"].number_value == 3
        if "layer_norm" in own:
            assert values["agent_options.layer_norm"].bool_value is True
            assert values["agent_options.target_entropy"].number_value == 0
            assert values["agent_options.learning_starts"].string_value == "none"
        assert folder.name.endswith(start.group_name)
        experiment = metadata.parse_experiment_plugin_data(content(metadata.EXPERIMENT_TAG))
        assert set(values) <= {info.name for info in experiment.hparam_infos}
        assert {info.name for info in experiment.hparam_infos if info.differs} == IDENTITY
        end = metadata.parse_session_end_info_plugin_data(content(metadata.SESSION_END_INFO_TAG))
        assert end.status == api_pb2.STATUS_SUCCESS
        experiments.append(experiment)
    # TensorBoard uses the columns of any one run.
    assert all(experiment == experiments[0] for experiment in experiments)
    assert [info.name.tag for info in experiments[0].metric_infos] == list(FINAL_METRICS)
    tags = scalar_tags(broken["equivariant"])
    assert set(FINAL_METRICS) <= tags | CORRELATIONS


def test_the_text_says_what_was_run(broken):
    for folder in broken.values():
        record = read_record(folder / "record.json")
        [event] = load(folder).Tensors("config/text_summary")
        text = event.tensor_proto.string_val[0].decode()
        rows = dict(re.findall(r"^\| (\S.*?) \| `(.*)` \|$", text, re.MULTILINE))
        assert rows["run"] == record.run_id
        assert rows["commit"].startswith(record.provenance.commit or "unknown")
        assert f"{record.base_policy.base_success:.0%} of 32 episodes" in rows["its success"]
        assert f"{record.base_policy.action_std:.2f}" in rows["its steerability"]
        assert rows["its warning"] == record.base_policy.warning
        own = record.config["agent_options"]
        assert rows.get("agent_options.lr") == ("0.0006" if "lr" in own else None)
        assert rows["evaluation.final_episodes"] == "5"


def test_the_final_evaluation_has_a_picture(broken):
    for folder in broken.values():
        [event] = load(folder).Images("eval/paths")
        assert event.step == read_record(folder / "record.json").budget.env_steps
        pixels = np.asarray(Image.open(io.BytesIO(event.encoded_image_string)))
        assert pixels.shape[2] == 3
        assert pixels.std() > 10
        assert ("eval/frames" in load(folder).Tags()["images"]) == rendering_works()


def test_a_picture_that_fails_does_not_harm_the_run(finished, monkeypatch, capsys):
    def fail(*args):
        raise OSError("no fonts")

    monkeypatch.setattr(observers, "draw_paths", fail)
    _, folder = finished
    other = execute(tiny_config(agent="zero"), folder.parent, progress=True)
    assert read_record(other / "record.json").status == "finished"
    assert load(other).Tags()["images"] == []
    assert "no fonts" in "".join(capsys.readouterr())


def test_a_full_disk_is_reported_in_one_sentence(finished, tmp_path, monkeypatch):
    record = read_record(finished[1] / "record.json")
    log = RunLog(tmp_path, record)
    # TensorBoard raises errors of its writing thread in later calls.
    full = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def fail(*args):
        raise full

    monkeypatch.setattr(log.writer.file_writer.event_writer._async_writer, "write", fail)
    with pytest.raises(UserError, match=r"cannot write TensorBoard's events .*No space left"):
        log.scalars({"eval/success_once": 0.5}, 0)
    log.finish()
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="cannot write TensorBoard's events"):
        RunLog(tmp_path / "file" / "run", record)
