"""The examples by themselves: `leashed.py` as docs/submit.md quotes it, and the example package."""

import re
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from symsteer.agents import AGENTS
from symsteer.agents.agent import AgentContext, Budget
from symsteer.agents.diagnostics import actor_equivariance_error
from symsteer.agents.replay import Transition
from symsteer.bench.sweep.suite import load_suite
from symsteer.bench.tasks import task_class
from symsteer.bench.variants import parse
from symsteer.errors import UserError
from symsteer.policies import POLICIES
from symsteer.policies.files import load_policy, save_policy
from symsteer.policies.geometry import Field, Group, Layout
from symsteer.registry import allow

REPOSITORY = Path(__file__).parents[2]
PAGE = (REPOSITORY / "docs" / "submit.md").read_text()
EXAMPLES = REPOSITORY / "examples"

LEASHED = "leashed:LeashedAgent"
SMOOTH = "symsteer_lab.smooth:SmoothAgent"
FLOW = "symsteer_lab.flow:FlowPolicy"
ZONE = "symsteer_lab.dead_zone:DeadZone"
WIDE = "symsteer_lab.wide_pick:WidePick"

OBS = Layout([Field("xy", 1), Field("height", 0)])
ACT = Layout([Field("xy", 1), Field("z", 0), Field("gripper", 0)])


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    for folder in (EXAMPLES, EXAMPLES / "symsteer-lab"):
        monkeypatch.syspath_prepend(folder)
    allow(LEASHED, SMOOTH, FLOW, ZONE, WIDE)


def built(name, decode, **options):
    kind = AGENTS.get(name)
    context = AgentContext(OBS, ACT, 4, 2, decode, lambda obs: obs)
    return kind(context, kind.Options(width=32, batch_size=64, lr=3e-3, warmup=0, **options))


def trained(agent, reward, updates=50):
    """On random decisions; the scalars of the last update, and the observations."""
    generator = torch.Generator().manual_seed(0)
    obs = torch.randn(512, 3, generator=generator)
    noise = torch.randn(512, 4, 4, generator=generator).clamp(-1.5, 1.5)
    ends = {"terminal": torch.ones(512), "truncated": torch.zeros(512)}
    executed = agent.context.decode(obs, noise)[:, :2]
    agent.observe(Transition(obs, noise, executed, reward(obs, noise), obs, **ends))
    for _ in range(updates):
        scalars = agent.update(agent.replay.sample(64))
    return scalars, obs


def test_the_page_quotes_the_file():
    assert f"```python\n{(EXAMPLES / 'leashed.py').read_text()}```\n" in PAGE


def test_the_actor_pays_for_the_squared_norm_of_its_noise():
    generator = torch.Generator().manual_seed(0)
    q, log_prob = torch.randn(2, 5, generator=generator), torch.randn(5, generator=generator)
    noise = torch.randn(5, 16, generator=generator)
    free, paid = (
        built(LEASHED, torch.add, leash=leash).actor_loss(q, noise, log_prob, None)
        for leash in (0, 0.5)
    )
    assert (paid - free).item() == pytest.approx(0.5 * noise.square().sum().item() / 5, rel=1e-5)


def test_a_short_leash_keeps_the_noise_near_zero_and_the_agent_equivariant():
    """On rewards that pay for noise as far out as possible, in the direction of the object."""

    def reward(obs, noise):
        direction = torch.nn.functional.normalize(obs[:, :2])
        return 4 * (noise[:, 0, :2].tanh() * direction).sum(1)

    def size(leash):
        agent = built(LEASHED, lambda obs, noise: noise.tanh(), leash=leash)
        _, obs = trained(agent, reward)
        assert actor_equivariance_error(agent, obs, Group.parse("C8")) < 1e-5
        return agent.act(obs, deterministic=True)[:, 0, :2].norm(dim=1).mean().item()

    assert size(1.0) < 0.5 * size(0.0)


def test_the_smooth_agent_learns_noise_that_decodes_to_smooth_chunks():
    # The noise 0 decodes to a chunk with jumps.
    jumps = torch.tensor([0.3, -0.3, 0.3, -0.3])[:, None]

    def roughness(weight):
        agent = built(SMOOTH, lambda obs, noise: noise + jumps, smoothness=weight)
        scalars, _ = trained(agent, lambda obs, noise: obs[:, 2])
        assert scalars["train/executed_roughness"] > 0
        return float(scalars["train/roughness"])

    assert roughness(10.0) < 0.5 * roughness(0.0)


@pytest.mark.parametrize(("name", "option"), [(LEASHED, "leash"), (SMOOTH, "smoothness")])
def test_a_negative_weight_is_refused(name, option):
    with pytest.raises(UserError, match=f"{option} must not be negative, not -1"):
        AGENTS.get(name).Options(**{option: -1})


def test_the_smooth_agent_refuses_chunks_of_one_action():
    kind = AGENTS.get(SMOOTH)
    with pytest.raises(UserError, match=r"raise policy\.execute"):
        kind.check(kind.Options(warmup=0), Budget(100, 1, 1, 50))


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


def test_the_flow_policy_learns_depends_on_its_noise_and_is_saved(tmp_path):
    kind = POLICIES.get(FLOW)
    generator = torch.Generator().manual_seed(0)
    obs = torch.rand(40, 201, 3, generator=generator) * 2 - 1
    actions = torch.cat([obs[:, :-1, :2] / 2, obs[:, :-1, 2:].expand(-1, -1, 2) / 2], dim=2)
    episodes = list(zip(obs, actions, strict=True))
    options = kind.Options(horizon=1, execute=1, width=64, depth=2, steps=400, warmup_steps=10)
    policy = kind.fit(options, episodes, OBS, ACT)

    noise = torch.randn(200, 1, 4, generator=generator, requires_grad=True)
    decoded = policy.decode(obs[0, :-1], noise)
    # The actions follow from the observation alone, here.
    assert (decoded[:, 0] - actions[0]).square().mean() < 0.2 * actions[0].square().mean()
    (gradient,) = torch.autograd.grad(decoded.sum(), noise)
    assert gradient.abs().max() > 0

    small, same = (kind.fit(kind.Options(width=8, steps=3), episodes, OBS, ACT) for _ in range(2))
    assert small.content_hash() == same.content_hash() != policy.content_hash()
    chunk = torch.randn(200, 8, 4, generator=generator)
    loaded = load_policy(save_policy(small, tmp_path), OBS, ACT)
    assert torch.equal(loaded.decode(obs[0, :-1], chunk), small.decode(obs[0, :-1], chunk))


@pytest.mark.parametrize("strength", [0.5, 1.0])
def test_the_dead_zone_shortens_steps_in_one_direction(strength):
    (variant,) = parse(f"{ZONE}:{strength}")
    count = 5
    variant.env = SimpleNamespace(num_envs=count, device=torch.device("cpu"), action_layout=ACT)
    commanded = torch.zeros(count, ACT.dim)
    commanded[:, 0] = torch.tensor([-1.0, -0.1, 0.0, 0.1, 1.0])
    commanded[:, 1] = -0.1
    executed = variant.action(commanded)
    lost = 0.4 * strength
    torch.testing.assert_close(executed[:, 0], torch.tensor([lost - 1, 0.0, 0.0, 0.1, 1.0]))
    assert torch.equal(executed[:, 1:], commanded[:, 1:])


def test_the_wide_task_observes_one_more_number():
    wide, stock = (task_class(name).observation_layout for name in (WIDE, "PickCube-v1"))
    assert wide.fields == (*stock.fields, Field("goal_distance", 0))
