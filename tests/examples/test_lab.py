"""The parts of the example package, each by itself."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from symsteer.agents import AGENTS
from symsteer.agents.agent import AgentContext, Budget
from symsteer.agents.replay import Transition
from symsteer.bench.tasks import task_class
from symsteer.bench.variants import parse
from symsteer.errors import UserError
from symsteer.policies import POLICIES
from symsteer.policies.files import load_policy, save_policy
from symsteer.policies.geometry import Field, Layout
from symsteer.registry import allow

CLASSES = ("smooth:SmoothAgent", "flow:FlowPolicy", "dead_zone:DeadZone", "wide_pick:WidePick")

OBS = Layout([Field("xy", 1), Field("height", 0)])
ACT = Layout([Field("xy", 1), Field("z", 0), Field("gripper", 0)])


@pytest.fixture(autouse=True)
def importable(monkeypatch):
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "examples" / "symsteer-lab")
    allow(*(f"symsteer_lab.{name}" for name in CLASSES))


def test_the_smooth_agent_learns_noise_that_decodes_to_smooth_chunks():
    kind = AGENTS.get("symsteer_lab.smooth:SmoothAgent")
    generator = torch.Generator().manual_seed(0)
    # The noise 0 decodes to a chunk with jumps.
    jumps = torch.tensor([0.3, -0.3, 0.3, -0.3])[:, None]
    context = AgentContext(OBS, ACT, 4, 2, lambda obs, noise: noise + jumps, lambda obs: obs)

    def draw(*shape):
        return torch.randn(64, *shape, generator=generator)

    ends = {"terminal": torch.ones(64), "truncated": torch.zeros(64)}
    step = Transition(draw(3), draw(4, 4), draw(2, 4), draw(), draw(3), **ends)

    def roughness(weight):
        agent = kind(context, kind.Options(width=32, lr=3e-3, smoothness=weight))
        agent.observe(step)
        for _ in range(100):
            scalars = agent.update(agent.replay.sample(32, agent.options.gamma))
        assert scalars["train/executed_roughness"] > 0
        return float(scalars["train/roughness"])

    assert roughness(10.0) < 0.5 * roughness(0.0)


def test_the_smooth_agent_refuses_what_it_cannot_use():
    kind = AGENTS.get("symsteer_lab.smooth:SmoothAgent")
    with pytest.raises(UserError, match="smoothness must not be negative"):
        kind.Options(smoothness=-1)
    with pytest.raises(UserError, match=r"raise policy\.execute"):
        kind.check(kind.Options(warmup=0), Budget(100, 1, 1, 50))


def test_the_flow_policy_learns_depends_on_its_noise_and_is_saved(tmp_path):
    kind = POLICIES.get("symsteer_lab.flow:FlowPolicy")
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

    small = kind.fit(kind.Options(width=8, steps=3), episodes, OBS, ACT)
    chunk = torch.randn(200, 8, 4, generator=generator)
    assert small.decode(obs[0, :-1], chunk).std(dim=0).min() > 0
    same = kind.fit(kind.Options(width=8, steps=3), episodes, OBS, ACT)
    assert small.content_hash() == same.content_hash() != policy.content_hash()
    loaded = load_policy(save_policy(small, tmp_path), OBS, ACT)
    assert torch.equal(loaded.decode(obs[0, :-1], chunk), small.decode(obs[0, :-1], chunk))


@pytest.mark.parametrize("strength", [0.5, 1.0])
def test_the_dead_zone_shortens_steps_in_one_direction(strength):
    (variant,) = parse(f"symsteer_lab.dead_zone:DeadZone:{strength}")
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
    kind = task_class("symsteer_lab.wide_pick:WidePick")
    stock = task_class("PickCube-v1")
    assert kind.observation_layout.dim == stock.observation_layout.dim + 1
    assert kind.observation_layout.fields[-1] == Field("goal_distance", 0)
