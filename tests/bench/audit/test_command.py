"""The commands `symsteer audit` and `audit-episodes`, and the pages made from their results."""

import json
import sys

import pytest

from symsteer.bench.audit import AuditSettings
from symsteer.bench.audit.study import cells
from symsteer.bench.tasks import task_class
from symsteer.bench.variants import VARIANTS
from symsteer.cli import main
from symsteer.errors import UserError
from symsteer.policies.files import save_policy
from symsteer.policies.symmetry.lifted import EquivariantDiffusionPolicy, EquivariantOptions


@pytest.fixture
def symsteer(monkeypatch, tmp_path):
    """Calls a verb in an empty folder; returns the exit code."""
    monkeypatch.chdir(tmp_path)

    def call(*arguments) -> int:
        monkeypatch.setattr(sys, "argv", ["symsteer", *map(str, arguments)])
        try:
            return main()
        except SystemExit as error:
            return int(error.code or 0)

    return call


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--task", "PickCub-v1"], "PickCube-v1"),
        (["--embodiment", "hand"], "floating, panda"),
        (["--variant", "action_gian:1"], "action_gain"),
        (["--variant", "all"], "action_gain:0.5"),
        (["--variant", "all:2"], "[0, 1]"),
        (["--variant", "wind:0.2..0.8"], "an audit measures one"),
        (["--group", "E8"], "C8"),
        (["--group", "C1"], "nothing to compare"),
        (["--group", "SO2"], "not finite"),
        (["--states", "2"], "at least 8"),
        (["--base-policy", "nowhere.safetensors"], "nowhere.safetensors"),
        (["--base-policy", "x.safetensors", "--task", "all"], "for one task"),
        (["-episodes", "--episodes", "-1"], "at least 1"),
        (["-episodes", "--base-policy", "x.safetensors"], "--actions expert"),
    ],
)
def test_mistakes(arguments, words, symsteer, capsys, tmp_path):
    if arguments[0] == "-episodes":
        arguments = ["audit-episodes", *arguments[1:]]
    else:
        arguments = ["audit", *arguments, "--out", "out"]
    assert symsteer(*arguments) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    assert words in lines[0]
    assert not any(tmp_path.iterdir())


def test_one_audit(symsteer, capsys, tmp_path):
    task = task_class("PickCube-v1")
    options = EquivariantOptions(channels=16, width=32, depth=1)
    policy = EquivariantDiffusionPolicy(options, task.observation_layout, task.action_layout)
    path = save_policy(policy, tmp_path / "policy")
    arguments = ("--variant", "action_gain:1", "--group", "C4", "--base-policy", path)
    assert symsteer("audit", *arguments, "--states", 8, "--out", "out") == 0
    shown = capsys.readouterr().out
    data = json.loads((tmp_path / "out" / "audit.json").read_text())
    assert data["states"] == 16
    assert data["base_policy"] == policy.content_hash()[:12]
    assert {"expert", "policy"} <= {row["subset"] for row in data["dynamics"]}
    assert "8 of the expert and 8 of the policy" in shown
    assert f"{data['dynamics'][0]['mm']['value']:.0f} mm [" in shown
    assert "Broken beyond rounding, beside motion: nothing." in shown
    assert (tmp_path / "out" / "map.png").read_bytes().startswith(b"\x89PNG")
    assert {square["body"] for square in data["map"]} == {"tool", "object"}


def test_a_table_of_audits(symsteer, capsys, tmp_path):
    variants = ("--variant", "none", "action_gain:0.5")
    arguments = ("audit", *variants, "--base-policy", "none", "--group", "C2", "--states", 8)
    assert symsteer(*arguments, "--out", tmp_path) == 0
    out = capsys.readouterr().out
    assert "unbroken" in out
    assert "`action_gain:0.5`" in out
    rows = json.loads((tmp_path / "summary.json").read_text())
    assert [row["variant"] for row in rows] == ["none", "action_gain:0.5"]
    cell = tmp_path / "PickCube-v1-floating-action_gain=0.5-C2" / "audit.json"
    before = cell.stat().st_mtime_ns
    # The same command measures nothing again, and says the same.
    assert symsteer(*arguments, "--out", tmp_path) == 0
    assert capsys.readouterr().out == out
    assert cell.stat().st_mtime_ns == before
    for text, words in (('{"version": 1}', "version 1"), ("{}", "damaged")):
        cell.write_text(text)
        assert symsteer(*arguments, "--out", tmp_path) == 2
        assert words in capsys.readouterr().err


def test_whole_episodes(symsteer, capsys):
    arguments = ("--episodes", 2, "--group", "C2", "--task", "PushCube-v1")
    assert symsteer("audit-episodes", *arguments) == 0
    out = capsys.readouterr().out
    assert out.startswith("PushCube-v1-floating-none-C2, expert\n2 episodes, 100% with contact\n")
    assert "before contact: within 1 % of the path 100.0%" in out


def test_cells():
    def variants(*texts):
        return [settings.variant for settings in cells(["PushT-v1"], texts, AuditSettings())]

    names = sorted(VARIANTS.names())
    wanted = [f"{name}:{strength}" for name in names for strength in ("0.5", "1")]
    assert variants("none", "all:0.5", "all:1") == ["none", *wanted]
    both = "action_gain:0.5+perception_bias:1"
    assert variants(both, "action_gain:0.5", both, "wind:0") == [both, "action_gain:0.5", "none"]
    tasks = [settings.task for settings in cells(["all"], ["none"], AuditSettings())]
    assert "TiltedPickCube-v1" in tasks
    assert "SeenPickCube-v1" not in tasks
    with pytest.raises(UserError, match="a chunk of 500 steps does not fit"):
        AuditSettings(chunk=500).check()
