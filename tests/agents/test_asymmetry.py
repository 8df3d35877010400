"""Agents between strict and free: their limits, their dial, and where they start."""

import copy
import dataclasses
import functools
import math

import pytest
import torch

from symsteer.agents.asymmetry import asymmetry
from symsteer.agents.diagnostics import actor_equivariance_error
from symsteer.agents.free_bias import displaced
from symsteer.agents.networks import dense, dense_of, within
from symsteer.agents.replay import Transition
from symsteer.policies.geometry import Field, Group, Layout
from symsteer.policies.networks.equivariant import Lift, Project, RegularLinear
from tests.agents.conftest import ACT, DOUBLE, EXECUTE, OBS, Problem, errors, trained

WITH_DIAL = ("residual-pathway", "relaxed", "projected")
ALL = (*WITH_DIAL, "constrained", "slow", "free-bias")
FREE = {
    "constrained": {"dual_lr": 0.0},
    "slow": {"rate": 1.0, "critic_speed": 1.0},
    "free-bias": {},
    **{name: {"penalty": 0.0} for name in WITH_DIAL},
}
STRICT = {
    "slow": {"rate": 0.0},
    "residual-pathway": {"penalty": math.inf},
    "free-bias": {"penalty": math.inf},
}


def layers_of(name):
    """Layers of all kinds with the matrices of the group on their inputs and outputs."""
    group = Group.parse(name)
    order = group.order
    # (u f)(g) = f(u^-1 g)
    moves = group.multiplication[group.inverse]
    shift = torch.nn.functional.one_hot(moves, order).double()
    rho_obs, rho_act = (group.representation(x, torch.float64, "cpu") for x in (OBS, ACT))

    def regular(fields):
        return torch.stack([torch.kron(m, torch.eye(fields).double()) for m in shift])

    return {
        "lift": (Lift(OBS, group, 3), rho_obs, regular(3)),
        "convolution": (RegularLinear(group, 3, 2), regular(3), regular(2)),
        "project": (Project(group, 3, ACT), regular(3), rho_act),
    }


@pytest.mark.parametrize("kind", ["lift", "convolution", "project"])
@pytest.mark.parametrize("name", ["C8", "C4", "D4"])
def test_the_nearest_map_is_the_mean_over_the_group(name, kind):
    layer, rho_in, rho_out = layers_of(name)[kind]
    layer = layer.double()
    matrix, bias = dense(layer)
    assert all(
        torch.allclose(near, own)
        for near, own in zip(layer.nearest(matrix, bias), (matrix, bias), strict=True)
    )
    generator = torch.Generator().manual_seed(0)
    several = torch.randn(2, *matrix.shape, generator=generator, dtype=torch.float64)
    biases = torch.randn(2, *bias.shape, generator=generator, dtype=torch.float64)
    near, near_bias = layer.without_parameters().nearest(several, biases)
    expected = (rho_out.mT @ several[:, None] @ rho_in).mean(1)
    torch.testing.assert_close(near, expected)
    torch.testing.assert_close(near_bias, (biases[:, None, None] @ rho_out).squeeze(2).mean(1))
    assert not torch.allclose(near, several)


@pytest.mark.parametrize("name", ALL)
def test_they_start_where_the_strict_agent_starts_and_leave_it(problem, name):
    agent = trained(name, 0, **FREE[name])
    # Layers are made in single precision.
    assert max(errors(agent, problem).values()) < 1e-6
    assert asymmetry(agent.actor) < 1e-7
    agent = trained(name, **FREE[name])
    worst = errors(agent, problem)
    assert min(worst.values()) > 1e-4, worst
    assert min(asymmetry(network) for network in agent.networks.values()) > 1e-4


@pytest.mark.parametrize("name", STRICT)
def test_at_the_strict_end_of_its_dial_an_agent_is_the_equivariant_one(problem, name):
    """From the first number on; after 20 updates to rounding."""
    batch = problem.batch(seed=9, dtype=torch.float64)
    for updates in (0, 20):
        agent, strict = (trained(n, updates, **STRICT.get(n, {})) for n in (name, "equivariant"))
        same = torch.equal if updates == 0 else functools.partial(torch.allclose, rtol=1e-12)
        for one, other in zip(agent.moments(batch.obs), strict.moments(batch.obs), strict=True):
            assert same(one, other)
        assert same(*(x.q_values(batch.obs, batch.noise) for x in (agent, strict)))


# A bandit: the best noise is a known function of the observation, the reward is minus the squared
# distance to it. A part of it rotates with the scene, a part is fixed in the world.

BANDIT_OBS = Layout([Field("xy", 1), Field("height", 0), Field("rod", 2)])
BANDIT_ACT = Layout([Field("xy", 1), Field("z", 0)])


def bandit_reward(obs, noise):
    direction = torch.nn.functional.normalize(obs[:, BANDIT_OBS.slice("xy")])
    left = torch.stack([-direction[:, 1], direction[:, 0]], dim=1)
    z = 0.8 * obs[:, BANDIT_OBS.slice("height")].tanh()
    best = torch.cat([0.45 * left + torch.tensor([0.7, 0.0]), z], dim=1)
    return -(noise - best.unsqueeze(1)).square().sum((1, 2))


def solve(problem, name, rounds=400, **options):
    """Final reward of the deterministic actor and its equivariance error."""
    bandit = dataclasses.replace(
        problem,
        obs_layout=BANDIT_OBS,
        act_layout=BANDIT_ACT,
        horizon=2,
        options={**problem.options, "width": 128, "batch_size": 128},
    )
    agent, base = bandit.agent(name, **options), bandit.agent("base", seed=1)
    generator = torch.Generator().manual_seed(2)
    for i in range(rounds):
        obs = torch.randn(64 if i else 512, BANDIT_OBS.dim, generator=generator)
        noise = (agent if i else base).act(obs)
        ends = {"terminal": torch.ones(len(obs)), "truncated": torch.zeros(len(obs))}
        actions, reward = agent.executed(obs, noise), bandit_reward(obs, noise)
        agent.observe(Transition(obs, noise, actions, reward, obs, **ends))
        agent.update(agent.replay.sample(128))
    obs = torch.randn(512, BANDIT_OBS.dim, generator=generator)
    reward = bandit_reward(obs, agent.act(obs, deterministic=True)).mean().item()
    return reward, actor_equivariance_error(agent, obs, Group.parse("C8"))


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("equivariant", {}),
        *(
            pytest.param(name, {"penalty": 1e8, "rounds": 150}, marks=pytest.mark.long)
            for name in WITH_DIAL
        ),
    ],
)
def test_a_strict_agent_cannot_solve_a_broken_problem(problem, name, options):
    """Best is 0."""
    reward, error = solve(problem, name, **options)
    assert reward < -0.8
    assert error < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("name", ALL)
def test_without_a_penalty_they_solve_it(problem, name):
    reward, error = solve(problem, name, **FREE[name])
    assert reward > -0.65
    assert error > 0.5


@pytest.mark.parametrize("name", WITH_DIAL)
def test_the_dial_orders_them(name):
    sizes = [
        [asymmetry(network) for network in trained(name, penalty=penalty).networks.values()]
        for penalty in (0.0, 10.0, 1000.0)
    ]
    for free, held, strict in zip(*sizes, strict=True):
        assert free > 1.05 * held > 2 * strict


def test_the_penalty_limits_the_asymmetric_numbers(problem):
    """Steps of lr outwards end where a pull inwards takes lr away: at 1 / (2 penalty)."""
    agent = problem.agent("residual-pathway", lr=0.01, penalty=5.0)
    numbers = [layer.free.weight for layer, _ in agent.actor.layers()]
    for _ in range(100):
        with torch.no_grad():
            for weight in numbers:
                weight += 0.01
            agent.settle("actor")
    for weight in numbers:
        torch.testing.assert_close(weight, torch.full_like(weight, 0.1), rtol=1e-3, atol=0)


def test_an_annealed_penalty_lets_the_numbers_go(problem):
    """After one half-life steps of lr end at twice the size."""
    sizes = []
    for half_life in (0, 100):
        agent = problem.agent("residual-pathway", lr=0.01, penalty=5.0, half_life=half_life)
        agent.optimizers["actor"].steps.fill_(100)
        with torch.no_grad():
            number = next(agent.actor.layers())[1]["free.weight"]
            for _ in range(300):
                number += 0.01
                agent.settle("actor")
        sizes.append(number.mean().item())
    assert sizes == pytest.approx([0.1, 0.2], rel=1e-2)


def test_slow_numbers_move_at_a_fraction_of_the_rate(problem):
    """The first step of Adam is lr for every number that has a gradient."""
    agent = trained("slow", 1, lr=1e-3, rate=0.25, critic_speed=2.0)
    for name, rate in (("actor", 0.25), ("critic", 0.5)):
        layer, parameters = next(agent.networks[name].layers())
        strict = dense_of(layer.strict, within("strict", parameters))
        whole = dense_of(layer, parameters)
        for one, other in zip(whole, strict, strict=True):
            assert (one - other).abs().max().item() == pytest.approx(1e-3 * rate, rel=1e-3)


@pytest.mark.parametrize("elastic", [False, True])
def test_multipliers_follow_the_paper(problem, elastic):
    agent = problem.agent("constrained", dual_lr=0.5, elastic=elastic)
    layers = [parameters for _, parameters in agent.actor.layers()]
    with torch.no_grad():
        layers[1]["gamma"].fill_(-2.0)
        layers[2]["gamma"].fill_(0.0)
        layers[2]["multiplier"].fill_(0.4)
        agent.settle("actor")
        agent.settle("actor")
    # lambda + 0.5 gamma, twice; with slack lambda + 0.5 (|gamma| - lambda).
    wanted = [0.75, 1.5, 0.1] if elastic else [1.0, -2.0, 0.4]
    assert [layer["multiplier"].item() for layer in layers] == pytest.approx(wanted)
    assert agent.penalty("actor", None).item() == pytest.approx(wanted[0] + 2 * abs(wanted[1]))


def test_the_truncated_actor_is_equivariant(problem):
    agent = copy.copy(trained("constrained", dual_lr=0.0))
    assert errors(agent, problem)["deterministic"] > 1e-4
    agent.mode = lambda obs: agent.alternatives()["truncated"](obs)
    assert errors(agent, problem)["deterministic"] < 1e-10


def test_a_displacement_is_told_by_the_names_of_fields():
    names = ("cube_xy", "tcp_to_cube_xy", "cube_to_goal_xy", "cube_to_peg_xy", "goal_xy", "tcp_xy")
    layout = Layout([Field("cube_z", 0), *(Field(name, 1) for name in names), Field("rod_xy", 2)])
    moves = displaced(layout)
    assert [moves[layout.slice(name)].diagonal().tolist() for name in names] == [
        *([1, 1], [1, 1], [-1, -1], [0, 0], [0, 0], [0, 0])
    ]
    assert not moves[layout.slice("rod_xy")].any()


def test_free_biases_say_which_shift_they_undo():
    """Critics of a symmetric world, whose inputs are displaced; each has a bias of its own, too."""
    layout = Layout([Field("tcp_xy", 1), Field("cube_xy", 1), Field("tcp_to_cube_xy", 1)])
    problem = Problem(layout)
    agent = problem.agent("free-bias", **DOUBLE, normalize_obs=lambda obs: 5 * obs)
    nothing = {"displacement_x": 0, "displacement_y": 0, "motion_x": 0, "motion_y": 0}
    assert agent.shifts() == nothing
    away = torch.tensor([0, 0, 0.02, -0.01, 0.02, -0.01], dtype=torch.float64)
    step = torch.zeros(ACT.dim, dtype=torch.float64)
    step[ACT.slice("xy")] = torch.tensor([0.15, 0.3], dtype=torch.float64)
    layer, parameters = next(agent.critic.layers())
    with torch.no_grad():
        weight, _ = dense_of(layer, parameters)
        inputs = torch.cat([-5 * away, step.repeat(EXECUTE)])
        parameters["free_bias"].add_(weight @ inputs + 0.1)
    wanted = {"displacement_x": 0.02, "displacement_y": -0.01, "motion_x": 0.15, "motion_y": 0.3}
    assert agent.shifts() == pytest.approx(wanted)


def test_without_the_place_of_a_body_no_shift_is_told(problem):
    assert problem.agent("free-bias").shifts() == {}
    assert Problem(BANDIT_OBS).agent("free-bias", critic_kind="noise").shifts() == {}
