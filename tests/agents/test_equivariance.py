"""Actors rotate with the scene and critics are invariant, for every element of the group.

Each test has a counterpart with a wrong geometry. Its errors must be large.
"""

import dataclasses
import math

import pytest
import torch

from symsteer.agents import AGENTS
from symsteer.policies.geometry import Field, Layout
from tests.agents.conftest import DOUBLE, errors, trained

GROUPS = ["C8", "C4", "D4"]
CRITICS = ["noise", "aliased", "sampler"]
OPTIONS = [
    *({"depth": depth, "layer_norm": norm} for depth in (1, 3) for norm in (True, False)),
    {"activation": "tanh"},
    {"critics": 5, "reduce": "mean"},
    *({"critic_kind": critic} for critic in ("noise", "sampler")),
]
PENALTIES = [
    (name, {"penalty": penalty}, limit)
    for name in ("residual-pathway", "relaxed", "projected")
    for penalty, limit in ((math.inf, 1e-10), (1e8, 1e-4))
]
EXACT = [
    *(("equivariant", {"group": group}, 1e-10) for group in GROUPS),
    *(("equivariant", options, 1e-10) for options in OPTIONS),
    *(("ensemble", {"group": g, "critic_kind": c}, 1e-10) for g in GROUPS for c in CRITICS),
    ("displaced", {"layers": "equivariant"}, 1e-10),
    *PENALTIES,
]


@pytest.mark.parametrize(("name", "options", "limit"), EXACT, ids=str)
def test_it_is_exact_after_training(problem, name, options, limit):
    agent = trained(name, 5 if name == "ensemble" else 20, **options)
    assert max(errors(agent, problem, options.get("group", "C8")).values()) < limit


@pytest.mark.parametrize("name", GROUPS)
def test_it_is_exact_in_single_precision_before_and_after_training(problem, name):
    for updates in (0, 20):
        agent = trained("equivariant", updates, torch.float32, group=name)
        assert max(errors(agent, problem, name).values()) < 1e-5


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
    worst = errors(wrong.agent("equivariant", group=name, **DOUBLE), problem, name)
    assert min(worst.values()) > 1e-2, worst


def test_parity_of_reflections_matters_to_dihedral_groups_only(problem):
    even = Layout([dataclasses.replace(f, odd=False) for f in problem.obs_layout.fields])
    wrong = dataclasses.replace(problem, obs_layout=even)
    for name, broken in (("D4", True), ("C8", False)):
        worst = max(
            errors(wrong.agent("equivariant", group=name, **DOUBLE), problem, name).values()
        )
        assert worst > 1e-2 if broken else worst < 1e-10


@pytest.mark.parametrize(
    ("name", "options"),
    [("equivariant", {"group": "C4"}), ("standard", {}), ("displaced", {}), ("wrong-group", {})],
)
def test_others_are_not_equivariant_under_the_group(problem, name, options):
    """A smaller group does not give a larger one."""
    worst = errors(trained(name, 0, **options), problem)
    assert min(worst[key] for key in ("mean", "deterministic", "q", "noise_q")) > 1e-2


@pytest.mark.parametrize("critic", CRITICS)
def test_the_control_is_exact_under_its_mirrored_action(problem, critic):
    agent = trained("wrong-group", 10, critic_kind=critic)
    assert AGENTS.get("wrong-group").role == "control"
    assert max(errors(agent, problem, sense=-1).values()) < 1e-10
    shapes = [
        [p.shape for net in one.networks.values() for p in net.parameters()]
        for one in (agent, trained("equivariant", 0, critic_kind=critic))
    ]
    assert shapes[0] == shapes[1]


def test_normalizers_must_commute_with_the_group(problem):
    block = problem.obs_layout.slice("tcp_xy")
    for scaled, broken in ((block.start, True), (block, False)):
        scale = torch.ones(problem.obs_layout.dim, dtype=torch.float64)
        scale[scaled] = 3.0
        worst = errors(
            problem.agent("equivariant", normalize_obs=lambda obs, s=scale: obs * s, **DOUBLE),
            problem,
        )
        if broken:
            assert min(worst["mean"], worst["q"], worst["noise_q"]) > 1e-2
        else:
            assert max(worst.values()) < 1e-10
