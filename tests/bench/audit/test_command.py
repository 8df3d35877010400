"""The command `symsteer audit`, and the pages that are made from its results."""

import json
import sys

import pytest
import torch

from symsteer.bench.audit.study import variant_texts
from symsteer.bench.tasks import task_class
from symsteer.bench.variants import VARIANTS
from symsteer.cli import main
from symsteer.errors import UserError
from symsteer.policies.files import save_policy
from symsteer.policies.symmetry.lifted import EquivariantDiffusionPolicy, EquivariantOptions

FAST = ("--count", 8, "--resets", 16)


def symsteer(monkeypatch, *arguments) -> int:
    monkeypatch.setattr(sys, "argv", ["symsteer", "audit", *map(str, arguments)])
    try:
        return main()
    except SystemExit as error:
        return int(error.code or 0)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--task", "PickCub-v1"], "PickCube-v1"),
        (["--embodiment", "hand"], "floating, panda"),
        (["--variant", "action_gian:1"], "action_gain"),
        (["--variant", "action_gain"], "action_gain:0.5"),
        (["--variant", "action_gain", "--strength", "2"], "[0, 1]"),
        (["--variant", "action_gain:0.2", "--strength", "0.5"], "takes the strength"),
        (["--strength", "0.5"], "takes the strength"),
        (["--group", "E8"], "C8"),
        (["--group", "C1"], "nothing to compare"),
        (["--group", "SO2"], "not finite"),
        (["--count", "2"], "at least 8"),
        (["--chunk", "0"], "at least 1"),
        (["--chunk", "500"], "smaller --chunk"),
        (["--seed", "-1"], "must lie in"),
        (["--base-policy", "nowhere.safetensors"], "nowhere.safetensors"),
        (["--base-policy", "x.safetensors", "--states", "expert"], "does not use it"),
        (["--base-policy", "x.safetensors", "--embodiment", "all"], "one task and embodiment"),
        (["--rollouts", "1", "--embodiment", "panda"], "--embodiment floating"),
        (["--rollouts", "-1"], "at least 1"),
        (["--rollouts", "1", "--base-policy", "x.safetensors"], "--actions expert"),
    ],
)
def test_mistakes(arguments, words, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    assert symsteer(monkeypatch, *arguments, "--out", tmp_path / "out") == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    assert words in lines[0]
    assert not any(tmp_path.iterdir())


@pytest.mark.skipif(torch.cuda.is_available(), reason="needs a machine without CUDA")
def test_cuda_where_there_is_none(monkeypatch, capsys):
    assert symsteer(monkeypatch, "--sim", "cuda") == 2
    assert "no CUDA device" in capsys.readouterr().err


def test_one_audit(monkeypatch, capsys, tmp_path):
    task = task_class("PickCube-v1")
    options = EquivariantOptions(channels=16, width=32, depth=1)
    policy = EquivariantDiffusionPolicy(options, task.observation_layout, task.action_layout)
    path = save_policy(policy, tmp_path / "policy")
    arguments = ("--variant", "action_gain:1", "--group", "C4", "--base-policy", path, *FAST)
    assert symsteer(monkeypatch, *arguments, "--json", "--out", tmp_path / "out") == 0
    data = json.loads(capsys.readouterr().out)
    assert data == json.loads((tmp_path / "out" / "audit.json").read_text())
    assert data["states"] == 16
    assert data["base_policy"] == policy.content_hash()[:12]
    assert {"expert", "policy"} <= {row["subset"] for row in data["dynamics"]}
    assert (tmp_path / "out" / "map.png").read_bytes().startswith(b"\x89PNG")
    head, *rows = (tmp_path / "out" / "map.csv").read_text().splitlines()
    assert head == "body,x_mm,y_mm,copies,mm"
    assert rows
    assert all(row.startswith(("tool,", "object,")) for row in rows)


def test_a_table_of_audits(monkeypatch, capsys, tmp_path):
    arguments = ("--variant", "none", "action_gain", "--strength", 0.5, "--states", "expert")
    arguments = (*arguments, "--group", "C2", *FAST, "--out", tmp_path)
    assert symsteer(monkeypatch, *arguments) == 0
    out = capsys.readouterr().out
    assert "unbroken" in out
    assert "`action_gain:0.5`" in out
    rows = json.loads((tmp_path / "summary.json").read_text())
    assert [row["variant"] for row in rows] == ["none", "action_gain:0.5"]
    assert len((tmp_path / "table.csv").read_text().splitlines()) == 3
    cell = tmp_path / "PickCube-v1-floating-action_gain=0.5-C2" / "audit.json"
    before = cell.stat().st_mtime_ns
    # Resuming measures nothing again, and says the same.
    assert symsteer(monkeypatch, *arguments, "--resume") == 0
    assert capsys.readouterr().out == out
    assert cell.stat().st_mtime_ns == before
    cell.write_text('{"version": 1}')
    assert symsteer(monkeypatch, *arguments, "--resume") == 2
    assert "version 1" in capsys.readouterr().err
    cell.write_text("{}")
    assert symsteer(monkeypatch, *arguments, "--resume") == 2
    assert "damaged" in capsys.readouterr().err


def test_whole_episodes(monkeypatch, capsys):
    assert symsteer(monkeypatch, "--rollouts", 2, "--group", "C2", "--task", "PushCube-v1") == 0
    out = capsys.readouterr().out
    assert out.startswith("PushCube-v1-floating-none-C2, expert\n2 episodes, 100% with contact\n")
    assert "before contact: within 1 % of the path 100.0%" in out


def test_variant_texts():
    assert variant_texts(["all"], [1.0])[0] == "none"
    assert len(variant_texts(["all"], [0.5, 1.0])) == 1 + 2 * len(VARIANTS.names())
    both = "action_gain:0.5+perception_bias:1"
    assert variant_texts([both, "action_gain", both], [0.5]) == [both, "action_gain:0.5"]
    assert variant_texts(["action_gain"], [0.0]) == ["none"]
    with pytest.raises(UserError):
        variant_texts(["none"], [0.5])
