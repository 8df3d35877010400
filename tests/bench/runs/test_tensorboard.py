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
from PIL import Image
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.custom_scalar import layout_pb2
from tensorboard.plugins.hparams import api_pb2, metadata

from symsteer.bench.runs import scalars
from symsteer.bench.runs.charts import DESCRIPTIONS, FINAL_METRICS
from symsteer.bench.runs.scalars import DETAILS, Scalars
from symsteer.bench.runs.tensorboard import RunLog
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


def points(folder, tag):
    return [(event.step, event.value) for event in load(folder).Scalars(tag)]


LONGER = tiny_config(env_steps=480, checkpoint_every=60)


@pytest.fixture(scope="module")
def continued(finished):
    """A run that was stopped after an evaluation that is in no checkpoint, and continued."""
    _, folder = finished
    stopped = stop(LONGER, folder.parent, 320)
    written = points(stopped, "eval/success_once")[-1][0]
    assert resume(stopped) == stopped
    return stopped, written


def assert_equals_record(folder):
    """Points of eval/ and diag/ are the record's evaluations: all of them, once, no others."""
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
                values[f"diag/{name}"] = float(kind) if value is None else value
        for tag, value in values.items():
            wanted.setdefault(tag, []).append((evaluation.env_steps, value))
            if tag.startswith("eval/") and evaluation.final and evaluation.env_steps < budget:
                # A reference: its success is a line to the end of the axis.
                wanted[tag].append((budget, value))
    assert {t for t in scalar_tags(folder) if t.startswith(("eval/", "diag/"))} == set(wanted)
    for tag, stored in wanted.items():
        shown = points(folder, tag)
        assert [step for step, _ in shown] == [step for step, _ in stored]
        assert [v for _, v in shown] == pytest.approx([v for _, v in stored], rel=1e-6, nan_ok=True)


def test_what_is_written_documented_and_described(every):
    written = set().union(*map(scalar_tags, every.values())) | CORRELATIONS
    details = {tag for tag in documented_tags() if DETAILS.fullmatch(tag.removeprefix("diag/"))}
    assert written == documented_tags() - details
    assert {tag.partition("/")[0] for tag in written} == NAMESPACES
    assert set(DESCRIPTIONS) <= written
    for folder in every.values():
        assert_equals_record(folder)
        assert charts_of(folder) == charts_of(every["equivariant"])


def test_references_are_lines_over_the_whole_axis(broken, continued):
    for folder in (*broken.values(), continued[0]):
        record = read_record(folder / "record.json")
        budget = record.config["env_steps"]
        lines = {tag for tag in scalar_tags(folder) if tag.startswith("reference/")}
        if record.role == "reference":
            assert not lines
            steps = [step for step, _ in points(folder, "eval/success_once")]
            assert steps == [record.budget.env_steps, budget]
            continue
        values = {"reference/base_success": record.base_policy.base_success}
        if feasible := record.feasible_q:
            values |= {"reference/q_low": feasible.low, "reference/q_high": feasible.high}
            values["reference/q_magnitude"] = 1
        assert lines == set(values)
        for tag, value in values.items():
            line = [(0, pytest.approx(value)), (budget, pytest.approx(value))]
            assert points(folder, tag) == line, tag


def test_errors_of_equivariance_are_shown_as_powers_of_ten(broken, finished):
    folder = broken["equivariant"]
    for kind in ("actor", "critic"):
        shown, error = f"log10/equivariance_{kind}", f"diag/equivariance_{kind}"
        wanted = [max(math.log10(max(v, 1e-30)), -8) for _, v in points(folder, error)]
        assert [v for _, v in points(folder, shown)] == pytest.approx(wanted, abs=1e-4)
    # Also those without a logarithm.
    evaluation = read_record(finished[1] / "record.json").evaluations[-1]
    evaluation.diagnostics.update(equivariance_actor=0.0, equivariance_critic=None)
    evaluation.nonfinite["diagnostics/equivariance_critic"] = "inf"
    values = scalars.evaluation_scalars(evaluation)
    assert values["log10/equivariance_actor"] == -8
    assert values["log10/equivariance_critic"] == math.inf


def test_a_continued_run_shows_what_one_shows_that_was_not_stopped(continued, tmp_path):
    folder, written = continued
    # The stopped process had written an evaluation that was repeated.
    assert written in [e.env_steps for e in read_record(folder / "record.json").evaluations][:-1]
    assert len(list(folder.glob("events.*"))) == 2
    assert_equals_record(folder)
    shutil.copytree(folder.parent / "base", tmp_path / "base")
    other = execute(LONGER, tmp_path)
    tags = scalar_tags(other)
    assert tags == scalar_tags(folder)
    assert "train/return" in tags
    for tag in tags:
        mine, theirs = points(folder, tag), points(other, tag)
        if tag.startswith("time/"):
            mine, theirs = ([step for step, _ in shown] for shown in (mine, theirs))
        assert mine == theirs, tag


def test_training_is_shown_at_some_steps_as_means_of_the_last_episodes(
    finished, tmp_path, monkeypatch
):
    monkeypatch.setattr(scalars, "POINTS", 10)
    monkeypatch.setattr(scalars, "RECENT", 3)
    returns: list[float] = []
    wanted: dict[int, list[float]] = {}
    stepped = Scalars.stepped

    def noting(self, run, values):
        returns.extend(values[0]["train/return"].tolist())
        wanted[run.env_steps] = returns[-3:]
        stepped(self, run, values)

    monkeypatch.setattr(Scalars, "stepped", noting)
    shutil.copytree(finished[1].parent / "base", tmp_path / "base")
    folder = execute(LONGER, tmp_path)
    assert len(returns) > 3
    # At a tenth of the budget each, and before each of the two fresh starts.
    assert 8 <= len(points(folder, "losses/critic")) <= 12
    shown = points(folder, "train/return")
    assert shown == [
        (step, pytest.approx(sum(wanted[step]) / len(wanted[step]))) for step, _ in shown
    ]
    assert len({value for _, value in shown}) > 1


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


def test_a_chart_shows_few_tags_and_all_of_them_are_written_and_described(broken):
    folder = broken["equivariant"]
    tags, shown = scalar_tags(folder) | CORRELATIONS, set()
    for patterns in charts_of(folder).values():
        matches = [tag for tag in tags if any(re.match(pattern, tag) for pattern in patterns)]
        # One line a run, and its level lines.
        assert len([tag for tag in matches if not tag.startswith("reference/")]) == 1
        assert len(matches) == len(patterns) <= 3
        shown |= set(matches)
    assert {tag for tag in tags if tag.startswith(("reference/", "log10/"))} <= shown
    assert shown <= set(DESCRIPTIONS)
    events = load(folder)
    for tag in set(DESCRIPTIONS) & scalar_tags(folder):
        assert events.SummaryMetadata(tag).summary_description == DESCRIPTIONS[tag]


def test_hyperparameters_can_be_compared_across_runs(broken):
    experiments = []
    for name, folder in broken.items():
        events = load(folder)

        def content(tag, events=events):
            return events.SummaryMetadata(tag).plugin_data.content

        values = metadata.parse_session_start_info_plugin_data(
            content(metadata.SESSION_START_INFO_TAG)
        ).hparams
        assert values["agent"].string_value == name
        assert folder.name.endswith(values["run"].string_value)
        assert values["demonstrations.count"].number_value == 3
        options = read_record(folder / "record.json").config["agent_options"]
        for key in {"lr", "penalty", "candidates", "target_entropy"} & options.keys():
            assert values[f"agent_options.{key}"].number_value == options[key]
        experiment = metadata.parse_experiment_plugin_data(content(metadata.EXPERIMENT_TAG))
        assert set(values) <= {info.name for info in experiment.hparam_infos}
        end = metadata.parse_session_end_info_plugin_data(content(metadata.SESSION_END_INFO_TAG))
        assert end.status == api_pb2.STATUS_SUCCESS
        experiments.append(experiment)
    # TensorBoard uses the columns of any one run.
    assert all(experiment == experiments[0] for experiment in experiments)
    assert experiments[0].hparam_infos[0].name == "run"
    assert [info.name.tag for info in experiments[0].metric_infos] == list(FINAL_METRICS)


def test_the_text_says_what_was_run(broken):
    record = read_record(broken["equivariant"] / "record.json")
    [event] = load(broken["equivariant"]).Tensors("config/text_summary")
    text = event.tensor_proto.string_val[0].decode()
    rows = dict(re.findall(r"^\| (\S.*?) \| `(.*)` \|$", text, re.MULTILINE))
    assert rows["run_id"] == record.run_id
    assert rows.get("provenance.commit") == record.provenance.commit
    assert rows["base_policy.warning"] == record.base_policy.warning
    assert rows["agent_options.lr"] == str(record.config["agent_options"]["lr"])


def test_the_final_evaluation_has_a_picture(broken):
    for folder in broken.values():
        [event] = load(folder).Images("eval/paths")
        assert event.step == read_record(folder / "record.json").budget.env_steps
        pixels = np.asarray(Image.open(io.BytesIO(event.encoded_image_string)))
        assert pixels.shape[2] == 3
        assert pixels.std() > 10


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
