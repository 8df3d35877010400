"""The example of docs/submit.md: quoted as it is, right, and trained as a user would place it."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import torch

from symsteer.agents import ReplayBuffer, SacConfig, make_agent
from symsteer.agents.diagnostics import orbit_variance
from symsteer.bench.sweep.suite import load_suite
from symsteer.leaderboard.admission import check
from symsteer.leaderboard.records import read_record
from symsteer.policies.geometry import Field, Group, Layout

REPOSITORY = Path(__file__).parents[2]
EXAMPLE = REPOSITORY / "examples" / "augmented.py"
TINY = """
    --env-steps 160 --num-envs 4 --demonstrations.count 3
    --policy.channels 8 --policy.width 16 --policy.depth 1 --policy.steps 20
    --policy.batch-size 32 --sac.width 16 --sac.batch-size 16 --sac.warmup 16 --sac.group C4
    --evaluation.every 160 --evaluation.episodes 2 --evaluation.final-episodes 3
    --evaluation.diagnostic-episodes 2 --evaluation.steerability-states 1
"""


def test_the_page_quotes_the_file():
    page = (REPOSITORY / "docs" / "submit.md").read_text()
    assert f"```python\n{EXAMPLE.read_text()}```\n" in page


def augmented_class():
    spec = importlib.util.spec_from_file_location("augmented_example", EXAMPLE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module.AugmentedAgent


def test_rotated_batches_teach_the_critics_the_symmetry():
    """On an invariant reward that the data show from one side only."""
    obs_layout = Layout([Field("object_xy", 1), Field("height", 0), Field("column", 1, odd=True)])
    act_layout = Layout([Field("xy", 1), Field("z", 0)])
    config = SacConfig(width=32, batch_size=64, lr=3e-3, group="C8", gamma=0.0)
    generator = torch.Generator().manual_seed(0)
    size, horizon = 512, 2
    obs = torch.randn(size, obs_layout.dim, generator=generator)
    obs[:, 0] = obs[:, 0].abs()
    noise = torch.rand(size, horizon, act_layout.dim, generator=generator) - 0.5
    reward = -(obs[:, :2] - noise[:, 0, :2]).square().sum(1)
    replay = ReplayBuffer(size, obs_layout.dim, horizon, act_layout.dim)
    replay.add(obs, noise, reward, obs, torch.ones(size))

    def share(agent):
        for _ in range(300):
            agent.update(replay.sample(config.batch_size))
        return orbit_variance(agent, obs, noise, Group.parse("C8"))["orbit_share"]

    plain = share(make_agent("standard", obs_layout, act_layout, horizon, config))
    told = share(augmented_class()(obs_layout, act_layout, horizon, config))
    assert told < 0.5 * plain


def test_one_new_file_in_agents_is_a_run(tmp_path):
    shutil.copytree(
        REPOSITORY / "agents", tmp_path / "agents", ignore=shutil.ignore_patterns("__pycache__")
    )
    shutil.copy(EXAMPLE, tmp_path / "agents")

    result = subprocess.run(
        [*(sys.executable, "-m", "bench", "run", "--agent", "augmented"), *TINY.split()],
        cwd=tmp_path,
        env=os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{REPOSITORY}"},
        capture_output=True,
        text=True,
    )
    assert result.returncode == 0, result.stderr
    (path,) = tmp_path.glob("runs/*/record.json")
    record = read_record(path)
    assert record.status == "finished"
    assert record.settings.agent == "augmented"
    assert record.budget.updates > 3
    # What the page says of files, rules and cells.
    copied = tmp_path / f"{path.parent.name}.json"
    shutil.copy(path, copied)
    (verdict,) = check([copied], tmp_path / "nothing-committed")
    unfair = {problem for problem in verdict.problems if "not in commit" not in problem}
    assert len(unfair) == 1
    assert "3 episodes, fewer than 100" in unfair.pop()


def test_the_suite_of_the_page_has_the_cells_of_the_leaderboard(tmp_path):
    page = (REPOSITORY / "docs" / "submit.md").read_text()
    pattern, replacement = re.search(r"^sed 's/(.*)/(.*)/' bench/suites/first", page, re.M).groups()
    first = (REPOSITORY / "bench" / "suites" / "first.toml").read_text()
    text, number = re.subn(pattern, replacement, first, flags=re.M)
    (tmp_path / "mine.toml").write_text(text)
    assert number == 1
    mine = {replace(run, agent="base") for run in load_suite(str(tmp_path / "mine.toml")).runs}
    assert mine == {run for run in load_suite("first").runs if run.agent == "base"}
