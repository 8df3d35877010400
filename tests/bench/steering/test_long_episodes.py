"""Q-values against the returns of long episodes, in a world whose values are known.

A walker is ``distance`` decisions from its goal, or stuck. Noise with a positive sum is a step
forward, other noise makes it stuck, and every decision before the success costs 1.
"""

from types import SimpleNamespace

import pytest
import torch

from symsteer.agents.diagnostics import agreement, value_errors
from symsteer.bench.steering.evaluation import (
    MAX_TAIL,
    long_episodes,
    long_limit,
    random_beginnings,
    tail_decisions,
)

GAMMA = 0.9
LIMIT = 6
TAIL = 29
FOREVER = -1 / (1 - GAMMA)
TOLERANCE = 1e-5
STUCK = 99


class Walk:
    """Seeds are distances; stands in for LatentNoiseEnv with an execution of one step."""

    device, execute = "cpu", 1

    def __init__(self, num_envs, endless=True):
        self.num_envs, self.env = num_envs, SimpleNamespace(max_episode_steps=LIMIT)
        self.max_episode_steps = long_limit(LIMIT, 1, GAMMA) if endless else LIMIT
        self.steps = 0

    def reset(self, seeds):
        self.distance = torch.tensor(seeds, dtype=torch.float32)
        self.won = torch.zeros(len(seeds), dtype=torch.bool)
        return self.distance[:, None]

    def step(self, noise):
        self.steps += 1
        forward = (noise.sum((1, 2)) > 0) & (self.distance != STUCK)
        self.distance = torch.where(
            forward, self.distance - 1, torch.full_like(self.distance, STUCK)
        )
        self.won |= self.distance == 0
        return SimpleNamespace(
            reward=-(~self.won).float(),
            success_once=self.won.clone(),
            obs_after=self.distance[:, None],
        )

    def pause(self, rows):
        pass


def forward(obs):
    return torch.ones(len(obs), 2, 1), torch.full((len(obs),), 0.5)


def normal(count, generator):
    return torch.randn(count, 2, 1, generator=generator)


def true_values(obs, noise):
    """Q of the actor that always goes forward; two critics."""
    distance = obs[:, 0].double()
    moves = (noise.sum((1, 2)) > 0) & (distance != STUCK)
    arrives = -(1 - GAMMA ** (distance - 1)) / (1 - GAMMA)
    return torch.where(moves, arrives, FOREVER).expand(2, -1)


def play(seeds, num_envs=4, sample=forward, **kwargs):
    env = Walk(num_envs, **kwargs)
    generator = torch.Generator().manual_seed(0)
    return long_episodes(env, sample, normal, seeds, GAMMA, generator), env


def errors(played, q_values, alpha=0.0, reduce="min"):
    options = SimpleNamespace(gamma=GAMMA, reduce=reduce)
    agent = SimpleNamespace(options=options, q_values=q_values)
    return value_errors(agent, played, alpha)


# Every other episode is on-policy: a third of these never succeeds.
SEEDS = [1, 5, 2, 4, STUCK, 6, 5, 3, 3, 2, STUCK, 6]


def test_exact_values_have_no_error():
    found = errors(play(SEEDS * 4)[0], true_values)
    # Failures count with all of their decisions: 1 + 2 + 6 + 5 + 3 + 6.
    assert found["q_decisions"] == 4 * 23
    for kind in ("", "off_"):
        assert abs(found[f"q_{kind}bias"]) < TOLERANCE
        assert found[f"q_{kind}bias_std"] < TOLERANCE
        assert found[f"q_{kind}correlation"] > 0.999
        assert found[f"q_{kind}rank_correlation"] > 0.999
    assert found["td_error"] < 1e-6
    assert found["return_std"] > 3


def test_a_shift_is_the_bias_and_all_is_overestimated():
    played, _ = play(SEEDS)
    exact, found = errors(played, true_values), errors(played, lambda *x: true_values(*x) + 2)
    assert found["q_bias"] == pytest.approx(exact["q_bias"] + 2)
    assert found["q_off_bias"] == pytest.approx(exact["q_off_bias"] + 2)
    assert found["q_overestimated"] == found["q_off_overestimated"] == 1
    # Nothing follows a success; elsewhere the discounted shift does.
    gaps = torch.tensor([-2.0] * 4 + [-2 * (1 - GAMMA)] * 19)
    assert found["td_error"] == pytest.approx(gaps.square().mean().sqrt().item(), rel=1e-5)


def test_a_critic_that_does_not_know_failure_is_found_out():
    """A bias over decisions with known returns at the time limit would be 0: those of successes."""

    def blind(obs, noise):
        return torch.where(obs[:, 0] == STUCK, 0.0, true_values(obs, noise))

    found = errors(play(SEEDS)[0], blind)
    assert found["q_bias"] == pytest.approx(12 / 23 * -FOREVER, abs=TOLERANCE)
    assert found["q_correlation"] < 0


def test_returns_without_variance_have_no_correlation():
    """The agent that always fails: the tail does not make differences between its decisions."""
    found = errors(play([STUCK] * 6)[0], lambda obs, noise: noise.sum((1, 2))[None].double())
    assert found["return_std"] < TOLERANCE
    assert found["q_correlation"] is found["q_off_correlation"] is None
    assert found["q_overestimated"] == 1


@pytest.mark.parametrize(("reduce", "taken"), [("min", -1), ("mean", 0)])
def test_the_target_takes_what_the_options_say_and_the_mean_has_the_bias(reduce, taken):
    played, _ = play([3])
    offsets = torch.tensor([[1.0], [-1.0], [0.0]])
    found = errors(played, lambda *x: true_values(*x)[:1] + offsets, reduce=reduce)
    assert found["q_bias"] == pytest.approx(0, abs=1e-6)
    gaps = taken * torch.tensor([GAMMA, GAMMA, 0.0])
    expected = gaps.square().mean().sqrt().item()
    assert found["td_error"] == pytest.approx(expected, rel=1e-5, abs=1e-6)
    # One episode has no off-policy decision.
    assert found["q_off_decisions"] == 0
    assert found["q_off_bias"] is found["return_off_mean"] is None


def test_soft_returns_hold_the_entropy_of_later_decisions():
    played, _ = play([3])
    # log pi is 0.5, so each of the two later decisions adds -alpha / 2.
    soft = torch.tensor([-1 + GAMMA * (-0.1 - 1 + GAMMA * -0.1), -1 + GAMMA * -0.1, 0.0])

    def q_values(obs, _):
        return soft[3 - obs[:, 0].long()][None]

    found = errors(played, q_values, alpha=0.2)
    assert found["q_bias"] == pytest.approx(0, abs=1e-6)
    assert found["td_error"] == pytest.approx(0, abs=1e-6)
    assert abs(errors(played, q_values)["q_bias"]) > 0.05


def test_returns_end_with_time_outs_that_end_episodes():
    played, env = play([STUCK, STUCK], num_envs=2, endless=False)
    assert env.steps == LIMIT

    def q_values(obs, _):
        left = torch.arange(LIMIT, 0, -1)
        return (-(1 - GAMMA**left) / (1 - GAMMA))[: len(obs)][None]

    on = SimpleNamespace(**{**vars(played), "off_policy": torch.zeros_like(played.off_policy)})
    found = errors(on, q_values)
    assert found["q_bias"] == pytest.approx(0, abs=1e-5)
    assert found["td_error"] == pytest.approx(0, abs=1e-5)
    assert errors(played, true_values)["return_mean"] > FOREVER / 2


def test_values_that_are_not_finite_show():
    q = torch.arange(9.0, dtype=torch.float64)
    found = agreement(q.where(q != 2, torch.nan), q)
    for name in ("bias", "bias_std", "correlation", "rank_correlation", "overestimated"):
        assert found[name] != found[name], name


def test_an_episode_goes_on_until_its_return_is_known_and_no_longer():
    _, env = play([4], num_envs=1)
    assert env.steps == 4
    played, env = play([STUCK], num_envs=1)
    assert env.steps == LIMIT - 1 + TAIL
    assert played.on_policy.sum() == LIMIT
    assert played.last.nonzero().tolist() == [[LIMIT - 2 + TAIL, 0]]


def test_off_policy_decisions_are_the_last_random_ones():
    def standing(obs):
        return torch.zeros(len(obs), 2, 1), torch.zeros(len(obs))

    played, _ = play([STUCK] * 12, num_envs=12, sample=standing)
    random = played.noise.abs().sum((2, 3)) > 0
    assert (
        random.sum(0).tolist()
        == random_beginnings(12, LIMIT)
        == [0, 1, 0, 2, 0, 3, 0, 4, 0, 5, 0, 6]
    )
    for column in range(1, 12, 2):
        row = random[:, column].sum() - 1
        assert played.off_policy[:, column].nonzero().tolist() == [[row]]
        assert played.last[:, column].nonzero().tolist() == [[row + TAIL - 1]]
    assert not played.on_policy[:, 1::2].any()
    assert not played.off_policy[:, 0::2].any()
    noise = played.noise[random]
    assert 0.6 < noise.std() < 1.4


def test_random_beginnings_are_spread_evenly():
    assert random_beginnings(1, 13) == [0]
    assert random_beginnings(8, 13) == [0, 1, 0, 4, 0, 7, 0, 10]
    long = random_beginnings(128, 13)[1::2]
    assert set(long) == set(range(1, 14))
    assert long == sorted(long)


def test_batches_do_not_change_what_the_actor_reaches():
    one, _ = play(SEEDS, num_envs=len(SEEDS))
    found = [errors(one, true_values)]
    for num_envs in (1, 5):
        played, _ = play(SEEDS, num_envs=num_envs)
        assert played.reward.shape[1] == len(SEEDS)
        found.append(errors(played, true_values))
    for name in ("q_bias", "return_mean", "td_error", "q_decisions"):
        values = [one[name] for one in found]
        assert values == pytest.approx([values[0]] * 3, abs=1e-6), name


def test_tail_decisions():
    assert [tail_decisions(gamma) for gamma in (0.0, 0.05, 0.5, 0.9, 0.95, 0.99)] == [
        *(1, 1, 5, TAIL, 59, 299)
    ]
    assert tail_decisions(0.99999) == MAX_TAIL
