"""The residual agent corrects executed actions within its bound, and nothing else."""

import pytest
import torch

from symsteer.policies.geometry import Field, Group, Layout, equivariance_error
from tests.agents.conftest import ACT, EXECUTE, HORIZON, OBS, trained

DOUBLE = {"dtype": torch.float64}


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
    agent = trained("residual")
    obs = problem.batch(1, dtype=torch.float64).obs.expand(8, -1)
    corrections = agent.act(obs, deterministic=True)[:, HORIZON:]
    assert corrections.std(0).max() > 1e-3


@pytest.mark.parametrize("layers", ["equivariant", "plain"])
def test_symmetry(problem, layers):
    agent = trained("residual", layers=layers)
    batch = problem.batch(64, 9, torch.float64, rows=agent.rows)
    group = Group.parse("C8")
    inputs, value = (batch.obs, batch.noise), Layout([Field("value", 0)])
    # Decoding does not depend on the layers.
    assert equivariance_error(agent.decode, inputs, (OBS, ACT), ACT, group) < 1e-10
    for error in (
        equivariance_error(agent.mode, (batch.obs,), (OBS,), ACT, group),
        equivariance_error(
            lambda *x: agent.q_values(*x)[..., None], inputs, (OBS, ACT), value, group
        ),
    ):
        assert error < 1e-10 if layers == "equivariant" else error > 1e-2
