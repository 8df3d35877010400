"""Detectors scored against simulated copies, through the command line."""

from __future__ import annotations

import dataclasses
import json
import math
import shutil

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from symsteer.bench.audit.result import AuditSettings
from symsteer.bench.detect.report import interval
from symsteer.bench.detect.study import Measure, _detection, auroc, mean_of_runs
from symsteer.bench.detect.truth import Truth, measure_truth
from symsteer.bench.runs.folder import run_id
from symsteer.bench.runs.run import execute
from symsteer.bench.runs.stored import stored_config, stored_policy
from symsteer.cli import main
from symsteer.errors import UserError
from tests.bench.tiny_run import tiny_config

pytestmark = pytest.mark.long

BROKEN = tiny_config("standard", task="PushCube-v1", variant="friction_patch:1", keep_replay=True)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a short run that kept its decisions; they are repeated until they suffice."""
    out = tmp_path_factory.mktemp("runs")
    execute(BROKEN, out, progress=False)
    folder = out / run_id(BROKEN, {})
    path = folder / "replay.safetensors"
    kept = load_file(path)
    assert len(kept["reward"]) >= 80
    assert kept["actions"].shape[1:] == (BROKEN.policy.execute, 7)
    save_file({name: torch.cat([x] * 4) for name, x in kept.items()}, path)
    return folder


def call(monkeypatch, capsys, *arguments):
    monkeypatch.setattr("sys.argv", ["symsteer", "detect", *map(str, arguments)])
    code = main()
    return code, capsys.readouterr()


def test_the_truth_is_where_copies_end_elsewhere(run, monkeypatch):
    """A patch of friction at x > 0 acts on objects there: these copies end near their start."""
    monkeypatch.setattr("symsteer.bench.detect.truth.LEAST_DEPARTURE", 0.0)
    config, _ = stored_config(run)
    settings = AuditSettings(
        config.task, variant=config.variant, group="C4", states="expert", count=24
    )
    truth = measure_truth(settings, stored_policy(run, config))
    assert truth.obs.shape[:2] == truth.departure.shape == (24, 4)
    inside = truth.place["object"][..., 0] > 0
    assert 0 < truth.broken.sum() < truth.reached.sum() / 2
    # How much more often depends on the policy, which is hardly trained.
    assert truth.broken[inside].float().mean() > 1.25 * truth.broken[~inside].float().mean()
    # Copies are turned about the origin by the elements of the group.
    turned = torch.stack([-truth.place["object"][:, 0, 1], truth.place["object"][:, 0, 0]], 1)
    torch.testing.assert_close(truth.place["object"][:, 1], turned, atol=1e-4, rtol=0)
    # Some copies in the unbroken world do not end exactly where the others do.
    assert truth.limit > 0
    quarter = math.pi / 2
    layout = stored_policy(run, config).act_layout
    torch.testing.assert_close(truth.actions[:, 1], layout.transform(truth.actions[:, 0], quarter))
    assert not torch.allclose(truth.actions[:, 1], truth.actions[:, 0], atol=0.1)
    seen = truth.obs[..., stored_policy(run, config).obs_layout.slice("cube_xy")]
    torch.testing.assert_close(seen.double(), truth.place["object"].double(), atol=2e-3, rtol=0)


def test_the_command_prints_a_table_and_writes_data_and_maps(run, tmp_path, monkeypatch, capsys):
    out = tmp_path / "found"
    options = ("--detector", "neighbours", "atlas", "--count", 8, "--group", "C4", "--out", out)
    code, printed = call(monkeypatch, capsys, run, *options)
    assert code == 0
    assert "AUROC" in printed.out
    data = json.loads((out / "detect.json").read_text())
    assert [d["score"] for d in data["detections"]] == ["neighbours", "atlas"]
    assert data["copies"] == 2 * 8 * 4
    assert (out / "detect.png").stat().st_size > 10_000
    code, again = call(monkeypatch, capsys, run, "--json", *options[:-2])
    assert json.loads(again.out) == data


def test_several_runs_give_means_over_those_in_the_same_world(run, tmp_path, monkeypatch, capsys):
    out = tmp_path / "found"
    elsewhere = dataclasses.replace(BROKEN, variant="obstacle:1")
    twin = shutil.copytree(run, tmp_path / run_id(elsewhere, {}))
    path = twin / "config.json"
    path.write_text(path.read_text().replace("friction_patch:1", "obstacle:1"))
    options = ("--detector", "neighbours", "--count", 8, "--group", "C4", "--out", out)
    code, printed = call(monkeypatch, capsys, run, twin, run, *options)
    assert code == 0
    first, second = json.loads((out / "summary.json").read_text())
    alone = json.loads((out / run.name / "detect.json").read_text())
    assert (first["variant"], second["variant"]) == ("friction_patch:1", "obstacle:1")
    assert first["runs"] == [run.name] * 2
    assert first["broken"] == [alone["broken"] / alone["copies"]] * 2
    correlation = alone["detections"][0]["correlation"]
    assert first["correlation"]["value"] == pytest.approx(correlation["value"])
    assert first["correlation"]["runs"] == 2
    assert "### PushCube-v1, floating, `obstacle:1`, C4" in printed.out
    assert (out / "summary.md").read_text().strip() in printed.out


def test_the_mean_of_runs_has_the_spread_of_runs_and_of_their_data():
    rng = np.random.default_rng(0)
    runs = [Measure.of(mean, mean + 0.1 * rng.standard_normal(1000)) for mean in (0.0, 3.0)]
    mean = mean_of_runs([runs[0], None, runs[1]])
    assert (mean.value, mean.runs) == (1.5, 2)
    # Both resampled runs are the first one in a quarter of the draws.
    assert mean.low == pytest.approx(-0.1, abs=0.06)
    assert mean.high == pytest.approx(3.1, abs=0.06)
    same = mean_of_runs([runs[0]] * 4)
    assert same.high - same.low == pytest.approx(2 * 1.96 * 0.1 / 2, rel=0.15)
    assert mean_of_runs([None, None]) is None
    assert interval(mean.to_json(), 3).endswith("(2 of 3 runs)")
    assert Measure.of(0.5, np.array([np.nan, 0.2, 0.4])).low >= 0.2


def test_areas_under_roc_curves():
    scores, labels = np.array([0.1, 0.4, 0.4, 0.9]), np.array([False, False, True, True])
    assert auroc(scores, labels) == pytest.approx(3.5 / 4)
    assert auroc(-scores, labels) == pytest.approx(0.5 / 4)
    assert np.isnan(auroc(scores, labels | True))


def test_scores_of_copies_and_of_orbits():
    """Two orbits of four copies are whole, one has lost a copy that would be broken."""
    departure = torch.tensor([[0.0, 0.0, 0.0, 0.1], [0.0] * 4, [0.0, 0.0, 0.0, 0.1]])
    reached = torch.ones(3, 4, dtype=torch.bool)
    reached[2, 3] = False
    nothing = torch.zeros(3, 4, 2)
    truth = Truth(nothing, nothing, departure, 0.05, reached, {"tool": nothing})
    assert truth.broken.nonzero().tolist() == [[0, 3]]
    # The broken copy has the largest score of all, its orbit also the smallest one.
    scores = torch.tensor([[0.0, 0.5, 0.5, 0.9], [0.3, 0.6, 0.3, 0.3], [0.3, 0.3, 0.7, 9.0]])
    found = _detection("d", "s", scores, truth, 0)
    assert (found.auroc.value, found.place_auroc.value) == (1.0, 1.0)
    assert found.correlation.value > 0.3
    worse = _detection("d", "s", -scores, truth, 0)
    assert worse.place_auroc.value == 0.0
    assert worse.auroc.value == 1.0


def test_mistakes(run, tmp_path, monkeypatch, capsys):
    code, printed = call(monkeypatch, capsys)
    assert (code, printed.out) == (2, "")
    assert "symsteer detect" in printed.err
    code, printed = call(monkeypatch, capsys, run, "--detector", "gates")
    assert (code, printed.out) == (2, "")
    assert "did you mean 'gate'" in printed.err
    code, printed = call(monkeypatch, capsys, tmp_path)
    assert code == 2
    assert "Traceback" not in printed.err
    unbroken = dataclasses.replace(BROKEN, variant="none")
    with pytest.raises(UserError, match="the run's world is unbroken"):
        measure_truth(AuditSettings(unbroken.task, variant="none"), None)
    (run / "replay.safetensors").rename(run / "elsewhere")
    code, printed = call(monkeypatch, capsys, run)
    (run / "elsewhere").rename(run / "replay.safetensors")
    assert code == 2
    assert "run it with --keep-replay" in printed.err
