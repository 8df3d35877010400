"""Actors rotate with the scene and critics are invariant, for every element of the group.

Each test has a counterpart with a wrong geometry. Its errors must be large.
"""

import dataclasses

import pytest
import torch

from symsteer.policies.geometry import Field, Group, Layout

GROUPS = ["C8", "C4", "D4"]
DTYPES = [(torch.float32, 1e-5), (torch.float64, 1e-10)]


def errors(agent, problem, name, dtype, size=64):
    """Relative errors over the group: mean, deterministic w, samples, log-probability, both Q.

    The true layouts are those of ``problem``; the agent may have other ones.
    """
    batch = problem.batch(size, seed=5, dtype=dtype)
    chunk = problem.act_layout.repeat(problem.horizon)
    eps = torch.randn(
        size, chunk.dim, generator=torch.Generator().manual_seed(6), dtype=torch.float64
    ).to(dtype)
    noise = 0.4 * batch.noise

    def quantities(obs, noise, eps):
        mean, log_scale = agent.moments(obs)
        sample, log_prob = agent.distribution.sample(mean, log_scale, eps)
        return {
            "mean": mean,
            "deterministic": agent.act(obs, deterministic=True).flatten(1),
            "sample": sample,
            "sample_log_prob": log_prob,
            "q": agent.q_values(obs, noise),
            "noise_q": agent.noise_q_values(obs, noise),
        }

    own = quantities(batch.obs, noise, eps)
    # A constant quantity would pass the test below.
    assert own["mean"].norm(dim=1).min() > 1e-2
    assert min(own[key].std(dim=1).min() for key in ("q", "noise_q")) > 1e-3
    worst = dict.fromkeys(own, 0.0)
    for angle, reflect in Group.parse(name).elements:
        moved = quantities(
            problem.obs_layout.transform(batch.obs, angle, reflect),
            problem.act_layout.transform(noise, angle, reflect),
            chunk.transform(eps, angle, reflect),
        )
        for key, value in own.items():
            turns = key in ("mean", "deterministic", "sample")
            expected = chunk.transform(value, angle, reflect) if turns else value
            error = (moved[key] - expected).abs().max() / value.abs().max()
            worst[key] = max(worst[key], error.item())
    return worst


def trained(problem, agent, dtype, updates=20):
    for seed in range(updates):
        agent.update(problem.batch(32, seed, dtype))
    return agent


@pytest.mark.parametrize("updates", [0, 20])
@pytest.mark.parametrize(("dtype", "limit"), DTYPES)
@pytest.mark.parametrize("name", GROUPS)
def test_equivariant_agent(problem, name, dtype, limit, updates):
    agent = problem.agent("equivariant", group=name, dtype=dtype, initial_output=1.0)
    trained(problem, agent, dtype, updates)
    assert max(errors(agent, problem, name, dtype).values()) < limit


@pytest.mark.parametrize(
    "options",
    [
        {"depth": 1},
        {"depth": 3},
        {"depth": 1, "layer_norm": False},
        {"depth": 3, "layer_norm": False},
        {"activation": "tanh"},
        {"bound_penalty": 0.1},
        {"critic": "noise"},
        {"critic": "sampler"},
        {"critics": 5, "reduce": "subset"},
    ],
    ids=str,
)
def test_equivariant_agent_with_other_options(problem, options):
    agent = problem.agent("equivariant", dtype=torch.float64, initial_output=1.0, **options)
    trained(problem, agent, torch.float64)
    assert max(errors(agent, problem, "C8", torch.float64).values()) < 1e-10


def without_vectors(layout):
    """The same numbers, all declared scalars."""
    return Layout([Field(f.name, 0, f.dim) for f in layout.fields])


def swapped(layout):
    """The same fields, with the first vector and the first scalar in the wrong order."""
    first, second, *rest = layout.fields
    return Layout([second, first, *rest])


@pytest.mark.parametrize("breaking", [without_vectors, swapped])
@pytest.mark.parametrize("name", GROUPS)
def test_a_wrong_layout_is_seen_in_every_quantity(problem, name, breaking):
    wrong = dataclasses.replace(
        problem,
        obs_layout=breaking(problem.obs_layout),
        act_layout=breaking(problem.act_layout),
    )
    agent = wrong.agent("equivariant", group=name, dtype=torch.float64, initial_output=1.0)
    worst = errors(agent, problem, name, torch.float64)
    assert min(worst.values()) > 1e-2, worst


def test_parity_of_reflections_matters_to_dihedral_groups_only(problem):
    even = Layout([dataclasses.replace(f, odd=False) for f in problem.obs_layout.fields])
    wrong = dataclasses.replace(problem, obs_layout=even)
    for name, broken in (("D4", True), ("C8", False)):
        agent = wrong.agent("equivariant", group=name, dtype=torch.float64, initial_output=1.0)
        worst = max(errors(agent, problem, name, torch.float64).values())
        assert worst > 1e-2 if broken else worst < 1e-10


def test_a_smaller_group_does_not_give_a_larger_one(problem):
    agent = problem.agent("equivariant", group="C4", dtype=torch.float64, initial_output=1.0)
    assert min(errors(agent, problem, "C8", torch.float64).values()) > 1e-2


def test_a_tanh_per_axis_is_seen(problem):
    agent = problem.agent("equivariant", dtype=torch.float64, initial_output=1.0)
    agent.distribution.mode = lambda mean: 1.5 * mean.tanh()
    worst = errors(agent, problem, "C8", torch.float64)
    assert worst["mean"] < 1e-10
    assert worst["deterministic"] > 1e-2


def test_normalizers_must_commute_with_the_group(problem):
    start = problem.obs_layout.slice("tcp_xy").start
    per_number = torch.ones(problem.obs_layout.dim, dtype=torch.float64)
    per_number[start] = 3.0
    per_block = torch.ones(problem.obs_layout.dim, dtype=torch.float64)
    per_block[problem.obs_layout.slice("tcp_xy")] = 3.0
    for scale, broken in ((per_number, True), (per_block, False)):
        agent = problem.agent(
            "equivariant",
            dtype=torch.float64,
            initial_output=1.0,
            normalize_obs=lambda obs, scale=scale: obs * scale,
        )
        worst = errors(agent, problem, "C8", torch.float64)
        if broken:
            assert min(worst["mean"], worst["q"], worst["noise_q"]) > 1e-2
        else:
            assert max(worst.values()) < 1e-10


def test_the_plain_agent_is_not_equivariant(problem):
    agent = problem.agent("standard", dtype=torch.float64, initial_output=1.0)
    assert min(errors(agent, problem, "C8", torch.float64).values()) > 1e-2
