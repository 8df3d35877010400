"""Members of a team learn what they would learn alone."""

from __future__ import annotations

import copy

import pytest
import torch

from symsteer.agents import AGENTS
from symsteer.agents.agent import AgentContext
from symsteer.agents.sac import can_join
from symsteer.agents.team import Team
from symsteer.policies import POLICIES
from tests.agents.conftest import EXECUTE, HORIZON

LEARNERS = [name for name in AGENTS.builtin if can_join(AGENTS.get(name))]
SEEDS = (3, 1, 2)
ROWS = 16


def members(problem, name, seeds=SEEDS, **options):
    """Agents that differ in seed, normaliser and decoder, with decisions of their own."""
    agents = []
    for seed in seeds:
        agent = problem.agent(
            name,
            seed=seed,
            dtype=torch.float64,
            normalize_obs=lambda obs, seed=seed: obs / (1 + seed),
            **options,
        )
        decode = agent.context.decode
        object.__setattr__(
            agent.context,
            "decode",
            lambda obs, noise, decode=decode, seed=seed: decode(obs, noise / (1 + seed)),
        )
        agent.observe(problem.transition(64, seed, agent.rows))
        agents.append(agent)
    return agents


def batch_of(agent):
    return agent.replay.sample(ROWS)


def alone(agents, updates):
    return [[agent.update(batch_of(agent)) for _ in range(updates)] for agent in agents]


def together(agents, updates):
    team = Team(agents)
    rounds = [team.update([batch_of(agent) for agent in agents]) for _ in range(updates)]
    return team, [list(scalars) for scalars in zip(*rounds, strict=True)]


def tensors(tree):
    if isinstance(tree, torch.Tensor):
        return [tree]
    if isinstance(tree, dict):
        tree = [tree[key] for key in sorted(tree, key=str)]
    return [t for part in tree for t in tensors(part)] if isinstance(tree, list | tuple) else []


def assert_same_state(agents, others):
    for agent, other in zip(agents, others, strict=True):
        mine, theirs = agent.state_dict(), other.state_dict()
        assert mine.keys() == theirs.keys()
        for x, y in zip(tensors(mine), tensors(theirs), strict=True):
            torch.testing.assert_close(x, y, rtol=1e-7, atol=1e-10)
        assert agent.updates == other.updates


KINDS = [(name, AGENTS.get(name).Options().critic_kind) for name in LEARNERS]
KINDS += [("ensemble", critic) for critic in ("noise", "sampler")]


@pytest.mark.parametrize(("name", "critic"), KINDS)
def test_members_learn_what_they_learn_alone(problem, name, critic):
    single, team = (members(problem, name, critic_kind=critic) for _ in range(2))
    expected, (_, scalars_of) = alone(single, 5), together(team, 5)
    assert_same_state(team, single)
    for mine, theirs in zip(scalars_of, expected, strict=True):
        for scalars, others in zip(mine, theirs, strict=True):
            assert scalars.keys() == others.keys()
            for key, value in scalars.items():
                torch.testing.assert_close(value, others[key], rtol=1e-7, atol=1e-10)
    # They do differ from each other, and act with what they have learned.
    obs = problem.batch(dtype=torch.float64).obs
    for agent, other in zip(team, single, strict=True):
        torch.testing.assert_close(agent.act(obs), other.act(obs))
    noise = [agent.mode(obs) for agent in team]
    assert not torch.allclose(noise[0], noise[1])
    for agent, other in zip(team, single, strict=True):
        torch.testing.assert_close(agent.q_values(obs, noise[0]), other.q_values(obs, noise[0]))


@pytest.mark.parametrize(
    "options",
    [
        {"reduce": "mean", "soft_backup": True, "timeouts_terminal": True, "activation": "tanh"},
        {"noise_bank": 0, "distill": "gaussian", "distill_steps": 0.5},
        {"distill": "actor", "layer_norm": False},
    ],
    ids=lambda options: "-".join(options),
)
def test_with_other_options(problem, options):
    single, team = (members(problem, "equivariant", **options) for _ in range(2))
    alone(single, 5)
    together(team, 5)
    assert_same_state(team, single)


@pytest.mark.parametrize("bases", [(0, 0), (0, 1)], ids=["one", "two"])
def test_members_decode_together_if_they_steer_the_same_policy(problem, bases, monkeypatch):
    """Copies of a policy are the same; another one is not taken for it."""
    kind, calls = POLICIES.get("plain"), []
    options = kind.Options(channels=8, width=8, depth=1, horizon=HORIZON, execute=EXECUTE)

    decode = kind.decode
    monkeypatch.setattr(
        kind, "decode", lambda self, obs, noise: calls.append(len(obs)) or decode(self, obs, noise)
    )

    def member(base, seed):
        with torch.random.fork_rng():
            torch.manual_seed(base)
            policy = kind(options, problem.obs_layout, problem.act_layout)
        agent_class = AGENTS.get("standard")
        options_of = agent_class.Options(**problem.options)
        agent = agent_class(AgentContext.of(policy.freeze(), seed=seed), options_of)
        agent.observe(problem.transition(64, seed))
        return agent

    single, team = ([member(base, seed) for seed, base in enumerate(bases)] for _ in range(2))
    alone(single, 2)
    calls.clear()
    together(team, 2)
    assert set(calls) == ({2 * ROWS} if len(set(bases)) == 1 else {ROWS})
    for agent, other in zip(team, single, strict=True):
        x, y = (one.networks["critic"].state_dict() for one in (agent, other))
        torch.testing.assert_close(x, y, rtol=1e-3, atol=1e-4)


def test_agents_join_and_leave(problem):
    """Alone, then together, then alone or in a smaller team; nothing is lost on the way."""
    single, agents = (members(problem, "residual-pathway") for _ in range(2))
    alone(single, 7)
    alone(agents, 2)
    team, _ = together(agents, 2)
    team.dissolve()
    smaller, _ = together(agents[:2], 2)
    alone(agents[2:], 2)
    smaller.dissolve()
    alone(agents, 1)
    assert_same_state(agents, single)


def test_members_must_have_made_equally_many_updates(problem):
    agents = members(problem, "standard")
    alone(agents[:1], 1)
    with pytest.raises(ValueError, match="equally many updates"):
        Team(agents)


def test_a_checkpoint_of_a_member_is_its_own(problem):
    """It holds what the team keeps for it, and not the others' parameters.

    The constrained agent has numbers that no optimiser changes.
    """
    agents = members(problem, "constrained")
    together(agents, 3)
    state = copy.deepcopy(agents[1].state_dict())
    for tensor in tensors(state):
        assert tensor.untyped_storage().nbytes() == tensor.numel() * tensor.element_size()
    (other,) = members(problem, "constrained", seeds=SEEDS[1:2])
    other.load_state_dict(state)
    other.replay.load_state_dict(agents[1].replay.state_dict())
    alone([other], 2)
    together(agents, 2)
    assert_same_state([other], agents[1:2])


def test_only_classes_that_say_so_can_join(problem):
    """The hooks of a subclass may not expect one more dimension."""
    agent = problem.agent("standard")

    class Own(type(agent)):
        def actor_loss(self, q, noise, log_prob, batch):
            return super().actor_loss(q, noise, log_prob, batch).mean()

    assert can_join(type(agent))
    assert not can_join(Own)
    assert not can_join(AGENTS.get("zero"))
