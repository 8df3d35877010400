"""Policies with irreps: exact for every rotation, of the plane or of space; couplings; mistakes."""

import itertools
import math

import pytest
import torch
from scipy.spatial.transform import Rotation

from symsteer.errors import UserError
from symsteer.policies import POLICIES
from symsteer.policies.geometry import Field, Group, Layout
from symsteer.policies.networks.irreps import PlanarIrreps, SpatialIrreps
from symsteer.policies.normalizer import Normalizer, clip_blocks
from tests.policies.conftest import as_type, small_options, untrained

SCENE = Layout(
    [
        *(Field("tcp_xy", 1), Field("tcp_z", 0)),
        *(Field("goal_xy", 1), Field("goal_z", 0)),
        *(Field("normal_xy", 1), Field("normal_z", 0)),
        Field("width", 0),
    ]
)
ACTION = Layout(
    [
        *(Field("xy", 1), Field("z", 0)),
        *(Field("tilt", 1, odd=True), Field("yaw", 0, odd=True)),
        Field("gripper", 0),
    ]
)


SMALL = {"channels": 8, "width": 8, "depth": 1, "ema_decay": 0.9, "batch_size": 32}


def rotations(count, seed=0):
    matrices = Rotation.random(count, random_state=seed).as_matrix()
    return torch.tensor(matrices, dtype=torch.float64)


def episodes(count, seed=0):
    """A point is pulled to the goal, and turns about the table's normal."""
    generator = torch.Generator().manual_seed(seed)
    pairs = []
    for _ in range(count):
        obs = (torch.rand(SCENE.dim, generator=generator) * 2 - 1).repeat(9, 1)
        normal = torch.randn(3, generator=generator)
        obs[:, 6:9] = normal / normal.norm()
        actions = torch.zeros(8, ACTION.dim)
        actions[:, :3] = 2 * (obs[:8, 3:6] - obs[:8, :3])
        actions[:, 3:6] = 0.3 * obs[:8, 6:9]
        actions[:, 6] = 1
        pairs.append((obs, actions))
    return pairs


@pytest.fixture(scope="module")
def spherical():
    options = small_options("spherical", steps=100, **SMALL)
    policy = POLICIES.get("spherical").fit(options, episodes(8), SCENE, ACTION)
    # Large actions, so that their bound is active.
    policy.act_normalizer.scale *= 8
    return policy


def turned(x, layout, matrix):
    """All vectors in space of ``x [..., layout.dim]``, turned."""
    rows = x.reshape(-1, layout.dim)
    return layout.turn(rows, matrix.to(x).expand(len(rows), 3, 3)).view_as(x)


@pytest.mark.parametrize(("dtype", "bound"), [(torch.float32, 1e-5), (torch.float64, 1e-10)])
def test_the_spherical_policy_commutes_with_every_rotation_of_space(spherical, dtype, bound):
    generator = torch.Generator().manual_seed(3)
    obs = torch.cat([obs for obs, _ in episodes(2, seed=5)]).double() * 1.5
    noise = 1.5 * torch.randn(len(obs), 8, ACTION.dim, generator=generator).double()
    with as_type(dtype, spherical):
        own = spherical.decode(obs.to(dtype), noise.to(dtype)).double()
        assert (own[..., :3].norm(dim=-1) > 0.999).any()
        assert own[..., :3].norm(dim=-1).max() <= 1 + 1e-6
        for matrix in rotations(6):
            moved = spherical.decode(
                turned(obs, SCENE, matrix).to(dtype), turned(noise, ACTION, matrix).to(dtype)
            )
            error = (moved.double() - turned(own, ACTION, matrix)).square().mean().sqrt()
            assert error / own.square().mean().sqrt() < bound


def test_both_learn_and_a_planar_policy_does_not_commute(spherical):
    options = small_options("so2", steps=60, **SMALL)
    planar = POLICIES.get("so2").fit(options, episodes(8), SCENE, ACTION)
    for policy in (planar, spherical):
        losses = [loss for _, loss in policy.training_record["losses"]]
        assert losses[-1] < 0.6 * losses[0]
    obs, noise = episodes(1)[0][0], torch.randn(9, 8, ACTION.dim)
    matrix = rotations(1)[0]
    for policy, exact in ((planar, False), (spherical, True)):
        own = policy.decode(obs, noise)
        moved = policy.decode(turned(obs, SCENE, matrix), turned(noise, ACTION, matrix))
        assert ((moved - turned(own, ACTION, matrix)).abs().max() < 1e-4) == exact


def test_a_gripper_that_only_turns_about_the_normal_is_hardly_tilted():
    """Its turn is random, so that the errors of the turn are large."""
    generator = torch.Generator().manual_seed(0)
    data = episodes(24)
    for obs, actions in data:
        turn = 2 * torch.rand(8, 1, generator=generator) - 1
        actions[:, 3:6] = turn * obs[:8, 6:9]
    options = small_options("spherical", steps=150, **SMALL)
    policy = POLICIES.get("spherical").fit(options, data, SCENE, ACTION)
    obs = torch.cat([obs[:8] for obs, _ in data])
    noise = torch.randn(len(obs), 8, ACTION.dim, generator=generator)
    turns, normals = policy.decode(obs, noise)[..., 3:6], obs[:, None, 6:9]
    along = (turns * normals).sum(-1, keepdim=True)
    tilts = turns - along * normals
    assert tilts.square().mean().sqrt() < 0.1 * along.square().mean().sqrt()


@pytest.mark.parametrize("irreps", [PlanarIrreps(4), SpatialIrreps()], ids=["planar", "spatial"])
def test_couplings_commute_with_rotations(irreps):
    generator = torch.Generator().manual_seed(0)
    u, v = torch.randn(2, irreps.dim, generator=generator, dtype=torch.float64)
    if isinstance(irreps, PlanarIrreps):
        angle = 0.7
        blocks = [torch.eye(1, dtype=torch.float64)]
        for k in irreps.degrees[1:]:
            c, s = math.cos(k * angle), math.sin(k * angle)
            blocks.append(torch.tensor([[c, -s], [s, c]], dtype=torch.float64))
    else:
        matrix, basis = rotations(1)[0], irreps.matrices[2]
        square = torch.einsum("aij,ik,bkl,jl->ab", basis, matrix, basis, matrix)
        blocks = [torch.eye(1, dtype=torch.float64), matrix, square]
    rho = torch.block_diag(*blocks)
    assert torch.allclose(rho @ rho.T, torch.eye(irreps.dim, dtype=torch.float64))
    forms = irreps.couplings
    first = torch.einsum("pkij,i,j->pk", forms, rho @ u, rho @ v)
    second = torch.einsum("pkij,i,j->pk", forms, u, v) @ rho.T
    assert torch.allclose(first, second, atol=1e-12)
    # No two of them are the same.
    flat = forms.flatten(1)
    assert torch.linalg.matrix_rank(flat) == len(flat)


def test_all_couplings_of_degrees_are_there():
    """(l, m) -> k from |l - m| to l + m, each once."""
    triples = itertools.product(range(3), repeat=3)
    wanted = sum(abs(left - right) <= out <= left + right for left, right, out in triples)
    assert len(SpatialIrreps().couplings) == wanted
    products = sum((l + m <= 3) + (l * m > 0) for l in range(4) for m in range(4))  # noqa: E741
    assert len(PlanarIrreps(3).couplings) == products


def test_norms_and_statistics_are_those_of_space():
    x = torch.randn(50, SCENE.dim, generator=torch.Generator().manual_seed(0))
    clipped = clip_blocks(x, SCENE.spatial, 1.0)
    assert clipped[:, :3].norm(dim=-1).max() <= 1 + 1e-6
    assert (clipped[:, :3].norm(dim=-1) > 0.999).any()
    fitted = Normalizer.fit(SCENE.spatial, x)
    assert fitted.scale[:3].unique().numel() == 1
    assert fitted.offset[:9].abs().max() == 0
    assert fitted.offset[9] != 0
    assert Normalizer.fit(SCENE, x).offset[2] != 0
    assert SCENE.spatial != SCENE


def test_names_of_vectors_in_space():
    names = [("xy", "z"), ("tilt", "yaw")]
    assert ACTION.spatial_vectors() == names
    assert ACTION.repeat(2).spatial_vectors() == [
        (f"{a}[{i}]", f"{b}[{i}]") for i in range(2) for a, b in names
    ]
    apart = Layout([Field("a_xy", 1), Field("b_z", 0), Field("c_xy", 2), Field("c_z", 0)])
    assert apart.spatial_vectors() == []


def test_mistakes():
    with pytest.raises(UserError, match=r"frequency 2, but .* up to 1; raise max_frequency"):
        untrained("so2", max_frequency=1)
    for fields, message in (
        ({"symmetry": "D4"}, "symmetry must be C_n"),
        ({"network": "unet"}, "leave network as it is"),
        ({"max_frequency": 0}, "max_frequency"),
    ):
        with pytest.raises(UserError, match=message):
            small_options("so2", **fields)
    with pytest.raises(UserError, match="turns in the plane"):
        untrained("spherical", action_frame="goal")
    assert untrained("so2", symmetry="C16").group == Group.parse("C16")
