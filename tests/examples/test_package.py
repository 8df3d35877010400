"""The example package, installed beside SymSteer as pip does it and used on the command line."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from symsteer import UserError, load
from symsteer.bench.runs.run import evaluate
from symsteer.registry import code_hash
from tests.bench.tiny_run import resume

REPOSITORY = Path(__file__).parents[2]
EXAMPLES = REPOSITORY / "examples"

NAMES = {"agent": "smooth", "policy": "flow-mlp", "task": "WidePick-v1", "variant": "dead_zone"}

RUN = """
    run --task WidePick-v1 --variant dead_zone:1 --policy.name flow-mlp
    --agent smooth --agent.smoothness 0.05 --quiet
    --num-envs 4 --demonstrations.count 3
    --policy.width 16 --policy.depth 1 --policy.steps 20 --policy.batch-size 32
    --agent.width 16 --agent.batch-size 16 --agent.warmup 16 --agent.group C4
    --evaluation.final-episodes 3 --evaluation.final-diagnostic-episodes 2
    --evaluation.steerability-states 1
"""

SUITE = """
[grid]
agent = ["smooth", "leashed:LeashedAgent"]
"agent.smoothness" = [0.05]

[run]
task = "WidePick-v1"
variant = "dead_zone:1"
env_steps = 160
num_envs = 4
demonstrations = { count = 3 }
policy = { name = "flow-mlp", width = 16, depth = 1, steps = 20, batch_size = 32 }
agent = { width = 16, batch_size = 16, warmup = 16, group = "C4" }
evaluation = { final_episodes = 3, final_diagnostic_episodes = 2, steerability_states = 1 }
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """A folder in which pip has installed the package."""
    source = tmp_path_factory.mktemp("source") / "symsteer-lab"
    site = tmp_path_factory.mktemp("site")
    ignored = shutil.ignore_patterns("__pycache__", "build", "*.egg-info")
    shutil.copytree(EXAMPLES / "symsteer-lab", source, ignore=ignored)
    options = ("--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--no-compile")
    subprocess.run(
        [sys.executable, "-m", "pip", "install", *options, "--target", site, source], check=True
    )
    return site


@pytest.fixture(scope="module", autouse=True)
def compiled(tmp_path_factory):
    """Where Python keeps no compiled files, the processes of this module share some of their own.

    Compiling torch takes longer than a run.
    """
    if not sys.dont_write_bytecode:
        yield
        return
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("PYTHONDONTWRITEBYTECODE", raising=False)
        patch.setenv("PYTHONPYCACHEPREFIX", str(tmp_path_factory.mktemp("compiled")))
        yield


def environment(*folders):
    """With the checkout and further folders on the import path."""
    path = os.pathsep.join(map(str, (REPOSITORY, *folders)))
    return os.environ | {"PYTHONPATH": path, "OMP_NUM_THREADS": "1"}


def symsteer(cwd, *arguments, site=None, expect=0):
    """Run a verb; returns what it prints, stderr last."""
    result = subprocess.run(
        [sys.executable, "-m", "symsteer", *map(str, arguments)],
        cwd=cwd,
        env=environment(*([site, EXAMPLES] if site else [])),
        capture_output=True,
        text=True,
    )
    assert result.returncode == expect, result.stdout + result.stderr
    return result.stdout + result.stderr


def record_of(folder):
    return json.loads((folder / "record.json").read_text())


def check_extensions(provenance, site):
    expected = code_hash_of(site / "symsteer_lab")
    assert {e["kind"]: e["name"] for e in provenance["extensions"]} == NAMES
    for extension in provenance["extensions"]:
        assert (extension["distribution"], extension["version"]) == ("symsteer-lab", "0.1.0")
        assert extension["sha256"] == expected


def code_hash_of(package):
    sys.path.insert(0, str(package.parent))
    try:
        return code_hash(package.name)
    finally:
        sys.path.remove(str(package.parent))


def problems(text):
    """The problems that `report --check` names, by agent."""
    by_agent = {}
    for line in text.splitlines():
        if line.endswith("NOT ADMISSIBLE"):
            agent = "leashed" if "leashed=LeashedAgent" in line else "smooth"
            by_agent[agent] = []
        elif line.startswith("  problem: "):
            by_agent[agent].append(line)
    return by_agent


@pytest.mark.slow
def test_run_sweep_report_and_admission(site, tmp_path):
    names = symsteer(tmp_path, "list", site=site)
    for name in NAMES.values():
        assert f"\n  {name} " in names

    symsteer(tmp_path, *RUN.split(), "--env-steps", 160, site=site)
    (folder,) = tmp_path.glob("runs/*-smooth-*")
    record = record_of(folder)
    assert (record["status"], record["role"]) == ("finished", "learner")
    assert record["budget"]["updates"] > 3
    assert record["base_policy"]["name"] == "flow-mlp"
    assert record["config"]["agent_options"]["smoothness"] == 0.05
    check_extensions(record["provenance"], site)
    said = symsteer(tmp_path, "evaluate", folder, site=site)
    assert "the same episodes as in the final evaluation" in said

    # The suite has the same run once more, and an agent that is not installed.
    (tmp_path / "suite.toml").write_text(SUITE)
    trust = ("--trust", "leashed:LeashedAgent")
    done = symsteer(tmp_path, "sweep", "suite.toml", "--workers", 1, *trust, site=site)
    assert "1 of 2 runs are finished already" in done
    assert len(list(tmp_path.glob("runs/*/record.json"))) == 2

    # Reading records needs no code of the agents.
    symsteer(tmp_path, "report", "runs")
    page = (tmp_path / "runs" / "leaderboard" / "LEADERBOARD.md").read_text()
    for name in ("WidePick-v1", "dead_zone:1", "smooth", "leashed:LeashedAgent"):
        assert name in page

    (tmp_path / "committed").mkdir()
    for path in tmp_path.glob("runs/*/record.json"):
        shutil.copy(path, tmp_path / "committed" / f"{path.parent.name}.json")
    said = symsteer(tmp_path, "report", "--check", "committed", expect=2)
    assert "it uses the agent smooth of symsteer-lab 0.1.0" in said
    expected = (
        "(3 of them) breaks the rule that episodes are as many as configured",
        "; commit all files first) breaks the rule",
    )
    unfair = {
        agent: [text for text in texts if not any(part in text for part in expected)]
        for agent, texts in problems(said).items()
    }
    assert unfair["smooth"] == []
    nobody = "agent leashed:LeashedAgent belongs to no installed distribution"
    assert any(nobody in text for text in unfair["leashed"])

    # Without the package, as here.
    missing = "'smooth' of the distribution symsteer-lab, which is not installed; install it"
    for verb in (resume, evaluate, load):
        with pytest.raises(UserError, match=missing):
            verb(folder)
