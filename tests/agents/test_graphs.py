"""Updates as graphs do what updates do, and contain nothing that a graph cannot repeat.

The graph here repeats the recorded operations on the processor, at the same addresses, as a CUDA
graph does on a GPU: no Python runs in between.
"""

from __future__ import annotations

import copy

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from symsteer.agents import AGENTS, graphs
from symsteer.agents.replay import Batch
from symsteer.agents.sac import can_join
from symsteer.agents.team import Team
from symsteer.policies import POLICIES
from tests.agents.conftest import HORIZON

LEARNERS = [name for name in AGENTS.builtin if can_join(AGENTS.get(name))]
WAITS = ("_local_scalar_dense", "nonzero", "is_nonzero", "masked_select", "unique", "equal")
WAITS += ("lift_fresh",)  # a constant of the processor, which would be copied to the device


class Recorder(TorchDispatchMode):
    """Records operations; refuses those that wait for the device."""

    def __init__(self):
        super().__init__()
        self.operations = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        name = function._schema.name.removeprefix("aten::")
        assert name not in WAITS, f"{name} waits for the device"
        result = function(*args, **(kwargs or {}))
        self.operations.append((function, args, kwargs or {}, result))
        return result

    @torch.no_grad()
    def replay(self):
        for function, args, kwargs, result in self.operations:
            again = function(*args, **kwargs)
            for old, new in zip(tree_leaves(result), tree_leaves(again), strict=True):
                if isinstance(old, torch.Tensor) and old.data_ptr() != new.data_ptr():
                    old.copy_(new)


@pytest.fixture(autouse=True)
def on_the_processor(monkeypatch):
    def record(compute, generators):
        compute()
        recorder = Recorder()
        with recorder:
            result = compute()
        return recorder, result

    monkeypatch.setattr(graphs, "record", record)


def filled(problem, name, seed=1, **options):
    agent = problem.agent(name, seed=seed, dtype=torch.float64, **options)
    agent.observe(problem.transition(64, seed, agent.rows))
    return agent


def update(agent):
    return agent.update(agent.new_batch())


def networks(agent):
    return {name: network.state_dict() for name, network in agent.networks.items()}


def assert_same(agents, others):
    for agent, other in zip(agents, others, strict=True):
        torch.testing.assert_close(networks(agent), networks(other), rtol=1e-9, atol=1e-12)
        torch.testing.assert_close(agent.alpha, other.alpha)


@pytest.mark.parametrize("name", LEARNERS)
def test_an_update_as_a_graph_is_the_update(problem, name):
    """Also with the numbers of distillations that follow, and when the replay has grown."""
    options = {"distill_steps": 1.5} if name in ("standard", "equivariant") else {}
    graphed, eager = (filled(problem, name, **options) for _ in range(2))
    obs = problem.batch(dtype=torch.float64).obs
    for _ in range(4):
        mine, theirs = graphed.update(Batch()), update(eager)
        torch.testing.assert_close(mine, theirs)
        torch.testing.assert_close(graphed.act(obs), eager.act(obs))
    assert_same([graphed], [eager])
    for agent in (graphed, eager):
        agent.observe(problem.transition(64, 5, agent.rows))
    graphed.update(Batch())
    update(eager)
    assert_same([graphed], [eager])


def test_a_grown_replay_is_recorded_anew(problem):
    graphed, eager = (filled(problem, "standard", replay_capacity=10_000) for _ in range(2))
    for agent, make in ((graphed, lambda a: a.update(Batch())), (eager, update)):
        make(agent)
        agent.observe(problem.transition(5000, 5))
        make(agent)
    assert_same([graphed], [eager])


@pytest.mark.parametrize("name", ["standard", "equivariant", "augmented"])
def test_a_team_as_a_graph_is_the_team(problem, name):
    graphed, eager = ([filled(problem, name, seed) for seed in (1, 2)] for _ in range(2))
    teams = Team(graphed), Team(eager)
    for _ in range(3):
        mine = teams[0].update([Batch(), Batch()])
        theirs = teams[1].update([agent.new_batch() for agent in eager])
        torch.testing.assert_close(mine, theirs)
    assert_same(graphed, eager)
    for team, agents in zip(teams, (graphed, eager), strict=True):
        team.dissolve()
        del agents[0]
    graphed[0].update(Batch())
    update(eager[0])
    assert_same(graphed, eager)


@pytest.mark.parametrize("name", [name for name in POLICIES.builtin if name != "escnn"])
def test_base_policies_can_be_recorded(problem, name):
    kind = POLICIES.get(name)
    policy = kind(kind.Options(horizon=HORIZON, execute=2), problem.obs_layout, problem.act_layout)
    batch = problem.batch()
    policy.decode(batch.obs, batch.noise)  # caches
    with Recorder():
        policy.decode(batch.obs, batch.noise)


def test_it_goes_on_from_a_checkpoint_as_it_would_have(problem):
    first, second = (filled(problem, "standard", seed) for seed in (1, 2))
    first.update(Batch())
    second.load_state_dict(copy.deepcopy(first.state_dict()))
    second.replay.load_state_dict(copy.deepcopy(first.replay.state_dict()))
    for agent in (first, second):
        agent.update(Batch())
    assert_same([first], [second])


def test_what_cannot_be_recorded_is_computed(problem, monkeypatch, capsys):
    """Nothing of the attempt is left, and one sentence says that it is slow."""
    graphed, eager = (filled(problem, "standard") for _ in range(2))

    def fail(compute, generators):
        compute()
        raise RuntimeError("operation not permitted when stream is capturing\nmore")

    monkeypatch.setattr(graphs, "record", fail)
    for _ in range(2):
        graphed.update(Batch())
        update(eager)
    assert_same([graphed], [eager])
    said = capsys.readouterr().out
    assert said.count("not CUDA graphs here") == 1
    assert "not permitted when stream is capturing" in said


def test_only_classes_that_say_so_are_in_graphs(problem):
    """Others may read numbers of the device; and a growing bound is a number of the processor."""
    agent = problem.agent("standard")
    assert not agent.in_graphs  # not on a processor

    class Own(type(agent)):
        pass

    ramp = problem.agent("residual", critic_kind="sampler", ramp=10)
    steady = problem.agent("residual", critic_kind="sampler")
    own = Own(problem.context(), agent.options)
    for one in (agent, own, ramp, steady):
        one.device = torch.device("cuda")
    agents = (agent, own, ramp, steady)
    assert [one.in_graphs for one in agents] == [True, False, False, True]
