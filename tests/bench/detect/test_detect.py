"""Detectors scored against simulated copies, through the command line."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from symsteer.bench.audit.result import AuditSettings
from symsteer.bench.detect.study import auroc
from symsteer.bench.detect.truth import measure_truth
from symsteer.bench.runs.folder import run_id
from symsteer.bench.runs.run import execute
from symsteer.bench.runs.stored import stored_config, stored_policy
from symsteer.cli import main
from symsteer.errors import UserError
from tests.bench.tiny_run import tiny_config

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


def test_the_truth_is_where_copies_end_elsewhere(run):
    """A patch of friction at x > 0 acts on objects there: these copies end near their start."""
    config, _ = stored_config(run)
    settings = AuditSettings(
        config.task, variant=config.variant, group="C4", states="expert", count=24
    )
    truth = measure_truth(settings, stored_policy(run, config))
    assert truth.obs.shape[:2] == truth.departure.shape == (24, 4)
    inside = truth.place["object"][..., 0] > 0
    assert 0 < truth.broken.sum() < truth.reached.sum() / 2
    assert truth.broken[inside].float().mean() > 2 * truth.broken[~inside].float().mean()
    # Copies are turned about the origin by the elements of the group.
    turned = torch.stack([-truth.place["object"][:, 0, 1], truth.place["object"][:, 0, 0]], 1)
    torch.testing.assert_close(truth.place["object"][:, 1], turned, atol=1e-4, rtol=0)
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


def test_areas_under_roc_curves():
    scores, labels = np.array([0.1, 0.4, 0.4, 0.9]), np.array([False, False, True, True])
    assert auroc(scores, labels) == pytest.approx(3.5 / 4)
    assert auroc(-scores, labels) == pytest.approx(0.5 / 4)
    assert np.isnan(auroc(scores, labels | True))


def test_mistakes(run, tmp_path, monkeypatch, capsys):
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
