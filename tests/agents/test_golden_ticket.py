"""The search for the best constant noise, in a problem with a known answer."""

from types import SimpleNamespace

import pytest
import torch

from symsteer.agents.agent import Budget
from symsteer.errors import UserError

ENVS, LIMIT, EXECUTE = 8, 50, 4


class World:
    """The cost of an episode is the distance of its noise from a target; no episode succeeds."""

    num_envs, max_episode_steps, execute = ENVS, LIMIT, EXECUTE

    def __init__(self, target):
        self.target, self.control_steps, self.seeds = target, 0, []

    def training_seeds(self, start, count):
        return [1000 * start + i for i in range(count)]

    def reset(self, seeds):
        assert len(seeds) == ENVS
        self.seeds.append(seeds)
        self.elapsed, self.cost = 0, torch.zeros(ENVS)

    def step(self, noise):
        steps = min(EXECUTE, LIMIT - self.elapsed)
        self.elapsed += steps
        self.control_steps += ENVS * steps
        self.cost -= (noise - self.target).square().mean((1, 2))
        ended = {"return": self.cost.clone(), "success_once": torch.zeros(ENVS, dtype=torch.bool)}
        return SimpleNamespace(episodes=ended)


def search(problem, target, budget, **options):
    agent = problem.agent("golden-ticket", seed=1, **options)
    world = World(target)
    asked = []

    def make_env(ignore_terminations):
        asked.append(ignore_terminations)
        return world

    assert agent.prepare(make_env, Budget(budget, ENVS, EXECUTE, LIMIT)) == 0
    assert asked == [True]
    return agent, world


def test_the_best_candidate_wins(problem):
    candidates = problem.agent("golden-ticket", seed=1).gaussian_noise(4)
    # Two rounds: the smallest budget for four candidates in eight environments, and a remainder.
    agent, world = search(problem, candidates[2], 2 * ENVS * LIMIT + 30)
    assert torch.equal(agent.ticket, candidates[2])
    assert world.control_steps == 2 * ENVS * LIMIT
    # Eight rows for two candidates are four initial states.
    assert agent.searched == {
        "ticket_success": 0.0,
        "ticket_episodes": 4.0,
        "ticket_candidates": 4.0,
    }
    # All candidates of a round play the same initial states; rounds differ.
    assert world.seeds == [[0] * 4 + [1] * 4, [s for s in range(1000, 1004) for _ in range(2)]]


def test_zero_is_a_candidate_and_wins_ties(problem):
    agent, _ = search(problem, torch.tensor(0.0), 2 * ENVS * LIMIT)
    assert not agent.ticket.any()
    agent, _ = search(problem, torch.tensor(torch.nan), 2 * ENVS * LIMIT)
    assert not agent.ticket.any()


def test_one_noise_for_all_states_also_after_loading(problem):
    agent, _ = search(problem, torch.tensor(1.0), 20 * ENVS * LIMIT, candidates=16)
    obs = problem.batch().obs
    assert agent.searched["ticket_candidates"] == 16
    assert torch.equal(agent.act(obs), agent.ticket.expand(32, -1, -1))
    assert agent.diagnostics(None)["ticket_rms"] == pytest.approx(
        agent.ticket.square().mean().sqrt().item()
    )
    other = problem.agent("golden-ticket", seed=9, candidates=16)
    other.load_state_dict(agent.state_dict())
    assert torch.equal(other.act(obs), agent.act(obs))
    assert other.diagnostics(None) == agent.diagnostics(None)


def test_a_budget_for_less_than_two_candidates_is_refused(problem):
    agent = problem.agent("golden-ticket")
    with pytest.raises(UserError, match=f"at least {ENVS * LIMIT}"):
        agent.check(agent.options, Budget(ENVS * LIMIT - 1, ENVS, EXECUTE, LIMIT))
