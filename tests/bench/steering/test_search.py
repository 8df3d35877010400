"""The search of a golden ticket, in a world where the best constant noise is known."""

import pytest
import torch

from symsteer.bench.runs.config import FIRST_TRAINING_SEED, training_seeds
from symsteer.bench.steering.latent_env import LatentNoiseEnv
from symsteer.bench.steering.search import search_ticket
from symsteer.bench.tasks import make
from symsteer.errors import UserError
from tests.bench.steering.test_latent_env import TASK, NoiseIsAction

ENVS, LIMIT = 8, 50


@pytest.fixture(scope="module")
def env():
    """Moving towards +x costs the more the faster it is; nothing is ever solved by chance."""
    env = make(TASK, num_envs=ENVS, variant="directional_reward:1")
    yield LatentNoiseEnv(env, NoiseIsAction(4), ignore_terminations=True)
    env.close()


def seeds(number, count):
    return training_seeds(7, number, count)


def test_the_slowest_of_those_who_pay_for_speed_wins(env):
    drawn = []

    def draw(count):
        noise = torch.zeros(count, 4, env.policy.act_layout.dim)
        speeds = torch.linspace(0.9, 0.2, count)
        speeds[2] = 0.05
        noise[:, :, env.policy.act_layout.slice("xy").start] = speeds[:, None]
        drawn.append(noise)
        return noise

    before = env.control_steps
    # Two rounds of candidates, the smallest budget for four in eight environments, and some rest.
    found = search_ticket(env, draw, 2 * ENVS * LIMIT + 30, seeds)
    assert torch.equal(found.ticket, drawn[0][2])
    assert found.candidates == 4
    # Eight rows for two candidates are four initial states.
    assert (found.success, found.episodes) == (0.0, 4)
    assert env.control_steps - before == 2 * ENVS * LIMIT


def test_of_equally_good_ones_the_first_is_kept(env):
    still = torch.zeros(4, 4, env.policy.act_layout.dim)
    found = search_ticket(env, lambda count: still[:count] + 0, 2 * ENVS * LIMIT, seeds)
    assert torch.equal(found.ticket, still[0])


def test_a_budget_for_less_than_two_candidates_is_refused(env):
    with pytest.raises(UserError, match=f"at least {ENVS * LIMIT}"):
        search_ticket(env, lambda count: torch.zeros(count, 4, 7), ENVS * LIMIT - 1, seeds)


def test_training_seeds_are_apart_from_all_others_and_repeat():
    first, second = training_seeds(3, 0, 100), training_seeds(3, 1, 100)
    assert first == training_seeds(3, 0, 100)
    assert len({*first, *second, *training_seeds(4, 0, 100)}) == 300
    assert min(first) >= FIRST_TRAINING_SEED
    assert max(first) < 2**31
