"""The example of docs/submit.md: quoted as it is, and it does what it says."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from symsteer import UserError
from symsteer.agents import AGENTS
from symsteer.agents.agent import AgentContext
from symsteer.agents.diagnostics import actor_equivariance_error
from symsteer.agents.replay import Transition
from symsteer.bench.sweep.suite import load_suite
from symsteer.policies.geometry import Field, Group, Layout
from symsteer.registry import allow

REPOSITORY = Path(__file__).parents[2]
PAGE = (REPOSITORY / "docs" / "submit.md").read_text()
EXAMPLES = REPOSITORY / "examples"
LEASHED = "leashed:LeashedAgent"

OBS = Layout([Field("object_xy", 1), Field("height", 0)])
ACT = Layout([Field("xy", 1), Field("z", 0)])


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    monkeypatch.syspath_prepend(EXAMPLES)
    allow(LEASHED)


def built(**options):
    kind = AGENTS.get(LEASHED)
    context = AgentContext(OBS, ACT, 2, 1, lambda obs, noise: noise.tanh(), lambda obs: obs)
    return kind(context, kind.Options(width=32, batch_size=64, lr=3e-3, warmup=0, **options))


def test_the_page_quotes_the_file():
    assert f"```python\n{(EXAMPLES / 'leashed.py').read_text()}```\n" in PAGE


def test_the_actor_pays_for_the_squared_norm_of_its_noise():
    generator = torch.Generator().manual_seed(0)
    q, log_prob = torch.randn(2, 5, generator=generator), torch.randn(5, generator=generator)
    noise = torch.randn(5, 6, generator=generator)
    free, paid = (built(leash=leash).actor_loss(q, noise, log_prob, None) for leash in (0, 0.5))
    assert (paid - free).item() == pytest.approx(0.5 * noise.square().sum().item() / 5, rel=1e-5)


def test_a_short_leash_keeps_the_noise_near_zero_and_the_agent_equivariant():
    """On rewards that pay for noise as far out as possible, in the direction of the object."""
    generator = torch.Generator().manual_seed(0)
    obs = torch.randn(512, 3, generator=generator)
    noise = torch.randn(512, 2, 3, generator=generator).clamp(-1.5, 1.5)
    direction = torch.nn.functional.normalize(obs[:, :2])
    reward = 4 * (noise[:, 0, :2].tanh() * direction).sum(1)
    ends = {"terminal": torch.ones(512), "truncated": torch.zeros(512)}

    def size(leash):
        agent = built(leash=leash)
        agent.observe(Transition(obs, noise, noise[:, :1].tanh(), reward, obs, **ends))
        for _ in range(150):
            agent.update(agent.replay.sample(64, agent.options.gamma))
        assert actor_equivariance_error(agent, obs, Group.parse("C8")) < 1e-5
        return agent.act(obs, deterministic=True)[:, 0, :2].norm(dim=1).mean().item()

    assert size(1.0) < 0.5 * size(0.0)


def test_a_negative_leash_is_refused():
    with pytest.raises(UserError, match="leash must not be negative, not -1"):
        AGENTS.get(LEASHED).Options(leash=-1)


def test_the_suite_of_the_page_has_cells_of_the_leaderboard(tmp_path, monkeypatch):
    monkeypatch.setitem(AGENTS.builtin, "leashed", LEASHED)
    command = r"^sed 's/(.*)/(.*)/' bench/suites/submission.toml"
    pattern, replacement = re.search(command, PAGE, re.M).groups()
    suite = (REPOSITORY / "bench" / "suites" / "submission.toml").read_text()
    text, number = re.subn(pattern, replacement, suite, flags=re.M)
    (tmp_path / "mine.toml").write_text(text)
    assert number == 1
    runs = load_suite(str(tmp_path / "mine.toml")).runs
    base = [run for run in load_suite("second").runs if run.agent == "base"]
    mine = {replace(run, agent="base", agent_options=base[0].agent_options) for run in runs}
    assert len(mine) == 40
    assert mine <= set(base)
    assert {run.agent for run in runs} == {"leashed"}
