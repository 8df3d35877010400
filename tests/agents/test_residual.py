"""The residual agent corrects executed actions within its bound, and nothing else."""

import dataclasses

import pytest
import torch

from symsteer.errors import UserError
from symsteer.policies.geometry import Group, equivariance_error
from tests.agents.conftest import ACT, EXECUTE, HORIZON, OBS

DOUBLE = {"dtype": torch.float64}


def batch_of(problem, agent, seed=0):
    """What a replay with a bank gives."""
    return problem.batch(64, seed, torch.float64, rows=agent.rows)


def learned(problem, agent, updates=20):
    for seed in range(updates):
        agent.update(batch_of(problem, agent, seed))
    return agent


def test_an_action_is_noise_and_a_correction(problem):
    agent = problem.agent("residual", residual_bound=0.3, initial_output=1.0, **DOUBLE)
    obs = problem.batch(64, dtype=torch.float64).obs
    action = agent.act(obs, deterministic=True)
    assert action.shape == (64, HORIZON + EXECUTE, ACT.dim)
    noise, correction = action.split([HORIZON, EXECUTE], dim=1)
    base, chunk = agent.context.decode(obs, noise), agent.decode(obs, action)
    assert torch.equal(chunk[:, EXECUTE:], base[:, EXECUTE:])
    moved = chunk[:, :EXECUTE] - base[:, :EXECUTE]
    assert moved.abs().max() > 0.01
    for block in ACT.repeat(EXECUTE).blocks:
        size = moved.flatten(1)[:, block].norm(dim=1)
        assert size.max() <= 0.3 + 1e-9
    within = (base[:, :EXECUTE] + 0.3 * correction).flatten(1)
    inside = torch.stack(
        [within[:, block].norm(dim=1) <= 1 for block in ACT.repeat(EXECUTE).blocks]
    ).all(0)
    assert inside.any()
    torch.testing.assert_close(
        chunk[inside, :EXECUTE].flatten(1), within[inside], rtol=0, atol=1e-12
    )


def test_the_base_policy_is_the_correction_zero(problem):
    agent = problem.agent("residual", warmup=100, **DOUBLE)
    obs = problem.batch(64, dtype=torch.float64).obs
    for action in (agent.act(obs), agent.gaussian_noise(64)):
        assert not action[:, HORIZON:].any()
        torch.testing.assert_close(
            agent.decode(obs, action), agent.context.decode(obs, action[:, :HORIZON])
        )
    exploring = problem.agent("residual", warmup=100, warmup_noise="squashed", **DOUBLE)
    assert exploring.act(obs)[:, HORIZON:].abs().max() > 0.5


def test_the_bound_grows_from_zero(problem):
    agent = problem.agent("residual", ramp=128, residual_bound=0.4, **DOUBLE)
    bounds = []
    for seed in range(5):
        bounds.append(agent.bound)
        agent.observe(problem.transition(32, seed, agent.rows))
    assert bounds == pytest.approx([0, 0.1, 0.2, 0.3, 0.4])
    agent.observe(problem.transition(32, 9, agent.rows))
    assert agent.bound == 0.4


def test_the_correction_depends_on_the_base_policys_actions(problem):
    agent = learned(problem, problem.agent("residual", initial_output=1.0, **DOUBLE))
    obs = problem.batch(1, dtype=torch.float64).obs.expand(8, -1)
    corrections = agent.act(obs, deterministic=True)[:, HORIZON:]
    assert corrections.std(0).max() > 1e-3


@pytest.mark.parametrize("layers", ["equivariant", "plain"])
def test_symmetry(problem, layers):
    options = {"layers": layers, "initial_output": 1.0, **DOUBLE}
    agent = learned(problem, problem.agent("residual", **options))
    batch = batch_of(problem, agent, 9)
    group = Group.parse("C8")
    found = [
        equivariance_error(agent.mode, (batch.obs,), (OBS,), ACT, group),
        equivariance_error(agent.decode, (batch.obs, batch.noise), (OBS, ACT), ACT, group),
    ]
    q = agent.q_values(batch.obs, batch.noise)
    for angle, reflect in group.elements:
        turned = agent.q_values(
            OBS.transform(batch.obs, angle, reflect), ACT.transform(batch.noise, angle, reflect)
        )
        found.append(((turned - q).abs().max() / q.abs().max()).item())
    # Decoding does not depend on the layers.
    assert found.pop(1) < 1e-10
    worst = max(found)
    assert worst < 1e-10 if layers == "equivariant" else worst > 1e-2


def test_a_checkpoint_continues(problem):
    agents = [problem.agent("residual", seed=seed, **DOUBLE) for seed in (0, 0, 5)]
    for agent in agents:
        agent.observe(problem.transition(64, 0, agent.rows))
    trained_agent, same, other = (learned(problem, agent, 3) for agent in agents)
    other.load_state_dict(trained_agent.state_dict())
    for agent in (trained_agent, same, other):
        learned(problem, agent, 2)
    obs = problem.batch(dtype=torch.float64).obs
    assert torch.equal(trained_agent.mode(obs), same.mode(obs))
    assert torch.equal(trained_agent.mode(obs), other.mode(obs))


def test_demonstrations_have_no_correction(problem):
    agent = problem.agent("residual", demonstration_share=0.5, **DOUBLE)
    step = problem.transition(64, 1)
    agent.observe_demonstrations(dataclasses.replace(step, noise=torch.zeros_like(step.noise)))
    agent.observe(problem.transition(64, 2, agent.rows))
    agent.owed = 1.0
    (batch,) = agent.batches()
    assert batch.noise.shape[1] == HORIZON + EXECUTE
    agent.update(batch)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"critic": "noise"}, "its critic is sampler"),
        ({"residual_bound": 0.0}, "residual_bound must lie"),
        ({"residual_bound": 3.0}, "residual_bound must lie"),
        ({"ramp": -1}, "ramp must not be negative"),
    ],
)
def test_bad_options_are_refused(problem, options, words):
    with pytest.raises(UserError, match=words):
        problem.agent("residual", **options)
