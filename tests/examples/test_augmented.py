"""The example of docs/submit.md: quoted as it is, and it learns what it claims to learn."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from symsteer.agents import AGENTS
from symsteer.agents.agent import AgentContext
from symsteer.agents.diagnostics import orbit_variance
from symsteer.agents.replay import Batch
from symsteer.bench.sweep.suite import load_suite
from symsteer.policies.geometry import Field, Group, Layout

REPOSITORY = Path(__file__).parents[2]
PAGE = (REPOSITORY / "docs" / "submit.md").read_text()
EXAMPLES = REPOSITORY / "examples"


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)


def test_the_page_quotes_the_file():
    assert f"```python\n{(EXAMPLES / 'augmented.py').read_text()}```\n" in PAGE


def test_rotated_batches_teach_the_critics_the_symmetry():
    """On an invariant reward that the data show from one side only."""
    obs_layout = Layout([Field("object_xy", 1), Field("height", 0), Field("column", 1, odd=True)])
    act_layout = Layout([Field("xy", 1), Field("z", 0)])
    context = AgentContext(obs_layout, act_layout, 2, 2, lambda obs, noise: noise, lambda obs: obs)
    generator = torch.Generator().manual_seed(0)
    size = 512
    obs = torch.randn(size, obs_layout.dim, generator=generator)
    obs[:, 0] = obs[:, 0].abs()
    noise = torch.rand(size, 2, act_layout.dim, generator=generator) - 0.5
    reward = -(obs[:, :2] - noise[:, 0, :2]).square().sum(1)
    rows = {"obs": obs, "noise": noise, "reward": reward, "next_obs": obs}
    rows["terminal"] = torch.ones(size)

    def share(name):
        kind = AGENTS.get(name)
        agent = kind(context, kind.Options(width=32, batch_size=64, lr=3e-3, gamma=0.0))
        agent.replay.add(rows)
        for _ in range(300):
            agent.update(agent.replay.sample(64))
        return orbit_variance(agent, obs, noise, Group.parse("C8"))["orbit_share"]

    assert share("augmented:AugmentedAgent") < 0.5 * share("standard")


def test_each_transition_is_rotated_as_a_whole(monkeypatch):
    seen = []
    kind = AGENTS.get("augmented:AugmentedAgent")
    layout = Layout([Field("xy", 1)])
    agent = kind(AgentContext(layout, layout, 1, 1, lambda obs, noise: noise, lambda obs: obs))
    monkeypatch.setattr(kind.__mro__[1], "update", lambda self, batch: seen.append(batch) or {})
    ones = torch.tensor([[1.0, 0.0]]).expand(64, 2)
    reward = torch.arange(64.0)
    agent.update(Batch(obs=ones, noise=ones[:, None], next_obs=2 * ones, reward=reward))
    (batch,) = seen
    torch.testing.assert_close(batch.noise[:, 0], batch.obs)
    torch.testing.assert_close(batch.next_obs, 2 * batch.obs)
    assert torch.equal(batch.reward, reward)
    assert len(batch.obs.round(decimals=4).unique(dim=0)) == 8


def test_the_suite_of_the_page_has_the_cells_of_the_leaderboard(tmp_path, monkeypatch):
    monkeypatch.setitem(AGENTS.builtin, "augmented", "augmented:AugmentedAgent")
    pattern, replacement = re.search(r"^sed 's/(.*)/(.*)/' bench/suites/first", PAGE, re.M).groups()
    first = (REPOSITORY / "bench" / "suites" / "first.toml").read_text()
    text, number = re.subn(pattern, replacement, first, flags=re.M)
    (tmp_path / "mine.toml").write_text(text)
    assert number == 1
    runs = load_suite(str(tmp_path / "mine.toml")).runs
    mine = {replace(run, agent="base", agent_options=None) for run in runs}
    assert mine == {run for run in load_suite("first").runs if run.agent == "base"}
    assert {run.agent for run in runs} == {"augmented"}
