"""What TensorBoard shows of a run, read back with TensorBoard's own loader."""

import errno
import io
import math
import os
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar import layout_pb2
from tensorboard.plugins.hparams import api_pb2, metadata

from symsteer.bench.runs import scalars
from symsteer.bench.runs.scalars import DETAILS, Means
from symsteer.bench.runs.tensorboard import DESCRIPTIONS, FINAL_METRICS, RunLog
from symsteer.errors import UserError
from symsteer.leaderboard.records import read_record
from tests.bench.tiny_run import execute, resume, stop, tiny_config

pytestmark = pytest.mark.long

DOCUMENTATION = Path(__file__).parents[3] / "docs" / "metrics.md"
NAMESPACES = {"eval", "train", "losses", "time", "diag", "log10", "reference"}
CORRELATIONS = {"diag/q_correlation", "diag/q_rank_correlation"}
"""Not measured in tiny runs: all of their episodes fail, so that returns have no variance."""


def load(folder):
    events = EventAccumulator(str(folder), size_guidance={"scalars": 0, "images": 0, "tensors": 0})
    events.Reload()
    return events


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


def points(folder):
    """Steps and values of each scalar."""
    events = load(folder)
    return {
        tag: [(event.step, event.value) for event in events.Scalars(tag)]
        for tag in events.Tags()["scalars"]
    }


LONGER = tiny_config(env_steps=320, checkpoint_every=60)


@pytest.fixture(scope="module")
def continued(finished):
    """A run that was stopped after an evaluation that is in no checkpoint, and continued."""
    _, folder = finished
    stopped = stop(LONGER, folder.parent, 160)
    written = points(stopped)["eval/success_once"][-1][0]
    assert resume(stopped) == stopped
    return stopped, written


def assert_equals_record(folder, shown):
    """Points of eval/, diag/ and log10/ are the record's evaluations: all of them, once."""
    record = read_record(folder / "record.json")
    budget = record.config["env_steps"]
    wanted: dict[str, list[tuple[int, float]]] = {}
    for evaluation in record.evaluations:
        episodes = evaluation.episodes.model_dump(by_alias=True)
        values = {
            f"eval/{name}": sum(column) / len(column)
            for name, column in episodes.items()
            if name not in ("seed", "direction", "nonfinite")
        }
        for name, value in evaluation.diagnostics.items():
            kind = evaluation.nonfinite.get(f"diagnostics/{name}")
            if DETAILS.fullmatch(name) is None and (value is not None or kind is not None):
                values[f"diag/{name}"] = error = float(kind) if value is None else value
                if name in ("equivariance_actor", "equivariance_critic"):
                    values[f"log10/{name}"] = max(math.log10(max(error, 1e-30)), -8)
        for tag, value in values.items():
            wanted.setdefault(tag, []).append((evaluation.env_steps, value))
            if tag.startswith("eval/") and evaluation.final and evaluation.env_steps < budget:
                # A reference: its success is a line to the end of the axis.
                wanted[tag].append((budget, value))
    assert {tag for tag in shown if tag.startswith(("eval/", "diag/", "log10/"))} == set(wanted)
    for tag, stored in wanted.items():
        assert [step for step, _ in shown[tag]] == [step for step, _ in stored]
        values = [value for _, value in stored]
        close = pytest.approx(values, rel=1e-5, abs=1e-5, nan_ok=True)
        assert [value for _, value in shown[tag]] == close, tag


def test_what_is_written_documented_described_and_drawn(every):
    shown = {folder: points(folder) for folder in every.values()}
    written = set().union(*shown.values()) | CORRELATIONS
    details = {tag for tag in documented_tags() if DETAILS.fullmatch(tag.removeprefix("diag/"))}
    assert written == documented_tags() - details
    assert {tag.partition("/")[0] for tag in written} == NAMESPACES
    assert set(DESCRIPTIONS) <= written
    for folder, values in shown.items():
        assert_equals_record(folder, values)
        assert charts_of(folder) == charts_of(every["equivariant"])
    drawn = set()
    for patterns in charts_of(every["equivariant"]).values():
        matches = [tag for tag in written if any(re.match(pattern, tag) for pattern in patterns)]
        # One line a run, and its level lines.
        assert len([tag for tag in matches if not tag.startswith("reference/")]) == 1
        assert len(matches) == len(patterns) <= 3
        drawn |= set(matches)
    assert {tag for tag in written if tag.startswith(("reference/", "log10/"))} <= drawn
    assert drawn <= set(DESCRIPTIONS)


def test_a_value_that_is_not_finite_is_shown(finished):
    evaluation = read_record(finished[1] / "record.json").evaluations[-1]
    evaluation.diagnostics.update(equivariance_actor=0.0, equivariance_critic=None)
    evaluation.nonfinite["diagnostics/equivariance_critic"] = "inf"
    values = scalars.evaluation_scalars(evaluation)
    assert values["log10/equivariance_actor"] == -8
    assert values["log10/equivariance_critic"] == math.inf


def test_training_scalars_are_means_of_the_last_episodes_and_of_all_updates(monkeypatch):
    monkeypatch.setattr(scalars, "RECENT", 3)
    recent, updates = Means({"return": [8.0]}), Means()
    for values in ([1.0, 2.0], [], [3.0, 5.0]):
        recent.add({"return": torch.tensor(values)})
        updates.add({"loss": torch.tensor(values)})
    assert recent.take() == {"return": pytest.approx(10 / 3)}
    assert recent.state() == {"return": [2.0, 3.0, 5.0]}
    assert updates.take() == {"loss": pytest.approx(11 / 4)}
    assert updates.take() == {}


def test_references_are_lines_over_the_whole_axis(broken, continued):
    for folder in (*broken.values(), continued[0]):
        record, shown = read_record(folder / "record.json"), points(folder)
        budget = record.config["env_steps"]
        if record.role == "reference":
            assert not any(tag.startswith("reference/") for tag in shown)
            steps = [step for step, _ in shown["eval/success_once"]]
            assert steps == [record.budget.env_steps, budget]
            continue
        values = {"reference/base_success": record.base_policy.base_success}
        if feasible := record.feasible_q:
            values |= {"reference/q_low": feasible.low, "reference/q_high": feasible.high}
            values["reference/q_magnitude"] = 1
        assert {tag: line for tag, line in shown.items() if tag.startswith("reference/")} == {
            tag: [(0, pytest.approx(value)), (budget, pytest.approx(value))]
            for tag, value in values.items()
        }


def test_a_continued_run_shows_what_one_shows_that_was_not_stopped(continued, tmp_path):
    folder, written = continued
    # The stopped process had written an evaluation that was repeated.
    assert written in [e.env_steps for e in read_record(folder / "record.json").evaluations][:-1]
    assert len(list(folder.glob("events.*"))) == 2
    shutil.copytree(folder.parent / "base", tmp_path / "base")
    mine, theirs = points(folder), points(execute(LONGER, tmp_path))
    assert_equals_record(folder, mine)
    assert mine.keys() == theirs.keys() > {"train/return"}
    for tag in mine:
        if tag.startswith("time/"):
            assert [step for step, _ in mine[tag]] == [step for step, _ in theirs[tag]]
        else:
            assert mine[tag] == theirs[tag], tag


def charts_of(folder):
    """The charts of the custom scalars, by title, and the regular expressions of their tags."""
    [event] = load(folder).Tensors("custom_scalars__config__")
    layout = layout_pb2.Layout.FromString(event.tensor_proto.string_val[0])
    charts = {}
    for category in layout.category:
        for chart in category.chart:
            patterns = list(chart.multiline.tag)
            for series in chart.margin.series:
                # A margin would cover the lines of other runs.
                assert series.value == series.lower == series.upper
                patterns.append(re.escape(series.value) + "$")
            charts[category.title, chart.title] = patterns
    return charts


def test_every_run_has_its_settings_its_text_and_a_picture(broken):
    experiments = []
    for name, folder in broken.items():
        events, record = load(folder), read_record(folder / "record.json")

        def content(tag, events=events):
            return events.SummaryMetadata(tag).plugin_data.content

        values = metadata.parse_session_start_info_plugin_data(
            content(metadata.SESSION_START_INFO_TAG)
        ).hparams
        assert values["agent"].string_value == name
        assert values["demonstrations.count"].number_value == 3
        options = record.config["agent_options"]
        for key in {"lr", "penalty", "candidates", "target_entropy"} & options.keys():
            assert values[f"agent_options.{key}"].number_value == options[key]
        experiment = metadata.parse_experiment_plugin_data(content(metadata.EXPERIMENT_TAG))
        assert set(values) <= {info.name for info in experiment.hparam_infos}
        end = metadata.parse_session_end_info_plugin_data(content(metadata.SESSION_END_INFO_TAG))
        assert end.status == api_pb2.STATUS_SUCCESS
        experiments.append(experiment)
        for tag in set(DESCRIPTIONS) & set(events.Tags()["scalars"]):
            assert events.SummaryMetadata(tag).summary_description == DESCRIPTIONS[tag]
        [event] = events.Tensors("config/text_summary")
        text = event.tensor_proto.string_val[0].decode()
        rows = dict(re.findall(r"^\| (\S.*?) \| `(.*)` \|$", text, re.MULTILINE))
        assert rows["run_id"] == record.run_id
        assert rows["base_policy.warning"] == record.base_policy.warning
        [event] = events.Images("eval/paths")
        assert event.step == record.budget.env_steps
        assert np.asarray(Image.open(io.BytesIO(event.encoded_image_string))).std() > 10
    # TensorBoard uses the columns of any one run.
    assert all(experiment == experiments[0] for experiment in experiments)
    assert [info.name.tag for info in experiments[0].metric_infos] == list(FINAL_METRICS)


def test_a_picture_that_fails_does_not_harm_the_run(finished, monkeypatch, capsys):
    def fail(*args):
        raise OSError("no fonts")

    monkeypatch.setattr(scalars, "draw_paths", fail)
    other = execute(tiny_config(agent="zero"), finished[1].parent, quiet=False)
    assert read_record(other / "record.json").status == "finished"
    assert load(other).Tags()["images"] == []
    assert "no fonts" in "".join(capsys.readouterr())


def test_a_full_disk_is_reported_in_one_sentence(finished, tmp_path, monkeypatch):
    record = read_record(finished[1] / "record.json")
    log = RunLog(tmp_path, record)

    # TensorBoard raises errors of its writing thread in later calls.
    def fail(*args):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(log.writer.file_writer.event_writer._async_writer, "write", fail)
    with pytest.raises(UserError, match=r"cannot write TensorBoard's events .*No space left"):
        log.scalars({"eval/success_once": 0.5}, 0)
    log.end(finished=True)
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="cannot write TensorBoard's events"):
        RunLog(tmp_path / "file" / "run", record)
