"""The scripted experts solve their tasks and commute with the symmetries."""

import pytest
import torch

from symsteer.bench.tasks import make
from symsteer.bench.tasks.experts import Expert
from symsteer.policies.geometry import Group
from tests.bench.shared import STATE_TASKS, shared


def success_rate(task, embodiment, episodes, first_seed=0):
    env = make(task, num_envs=episodes, embodiment=embodiment)
    env.reset(seed=list(range(first_seed, first_seed + episodes)))
    expert = Expert(env)
    solved = torch.zeros(episodes, dtype=torch.bool)
    for _ in range(env.max_episode_steps):
        solved |= env.step(expert.act())[-1]["success"]
        if solved.all():
            break
    env.close()
    return solved.float().mean().item()


@pytest.mark.parametrize("task", STATE_TASKS)
def test_expert_solves_the_floating_task(task):
    assert success_rate(task, "floating", 16) >= 0.9


@pytest.mark.slow
@pytest.mark.parametrize("task", STATE_TASKS)
@pytest.mark.parametrize(("embodiment", "least"), [("floating", 0.95), ("panda", 0.9)])
def test_expert_success_over_200_seeds(task, embodiment, least):
    assert success_rate(task, embodiment, 200, first_seed=10_000) >= least


@pytest.mark.parametrize("task", STATE_TASKS)
def test_expert_is_equivariant(task):
    env = shared(task, 8)
    env.reset(seed=list(range(8)))
    expert = Expert(env)
    elements = Group.parse("D8").elements[::3]
    # Far enough for every expert to have its object in hand.
    for step in range(24):
        action = expert.act()
        if step % 3 == 0:
            state = env.get_state_dict()
            for angle, reflect in elements:
                env.set_state_dict(env.transform_state(state, angle, reflect))
                expected = env.action_layout.transform(action, angle, reflect)
                # A float error may tip a threshold for one state in many, no more.
                close = torch.isclose(expert.act(), expected, atol=2e-3).all(dim=1)
                assert close.float().mean() >= 7 / 8, (step, angle, reflect)
            env.set_state_dict(state)
        env.step(action)
