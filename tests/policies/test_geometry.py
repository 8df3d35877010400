"""Layouts and groups: representations, agreement with escnn, serialisation, user mistakes."""

import math
import subprocess
import sys

import pytest
import torch

from symsteer.errors import UserError
from symsteer.policies.geometry import Field, Group, Layout, equivariance_error
from symsteer.policies.networks.equivariant import Lift, Project, RegularLinear
from tests.marks import need_escnn

LAYOUT = Layout(
    [
        Field("xy", 1),
        Field("z", 0),
        Field("tilt", 1, odd=True),
        Field("yaw", 0, odd=True),
        Field("square", 4, 2),
        Field("rod", 2, odd=True),
        Field("third", 3),
    ]
)
GROUPS = ["C1", "C2", "C3", "C6", "C8", "D2", "D3", "D8"]


@pytest.mark.parametrize("name", GROUPS)
def test_representation_is_a_homomorphism(name):
    group = Group.parse(name)
    rho = group.representation(LAYOUT)
    product = torch.einsum("gij,hjk->ghik", rho, rho)
    assert torch.allclose(product, rho[group.multiplication], atol=1e-12)
    inverse = rho[group.inverse]
    assert torch.allclose(inverse, rho.transpose(1, 2), atol=1e-12)


@pytest.mark.parametrize("name", [*GROUPS, "SO2"])
def test_field_type_is_escnns_in_the_same_basis(name):
    need_escnn()
    group = Group.parse(name)
    field_type = LAYOUT.field_type(group)
    assert field_type.size == LAYOUT.dim
    n = group.rotations
    elements = group.elements if n else [(0.37, False)]
    for index, (angle, reflect) in enumerate(elements):
        value = (int(reflect), index % n) if group.reflections else index if n else angle
        element = field_type.gspace.fibergroup.element(value)
        theirs = torch.tensor(field_type.representation(element))
        assert torch.allclose(theirs, LAYOUT.matrix(angle, reflect), atol=1e-9)


def test_transform_rotates_each_frequency_and_mirrors_what_is_odd():
    x = torch.ones(LAYOUT.dim, dtype=torch.float64)
    x[LAYOUT.slice("rod")] = torch.tensor([1.0, 0.0], dtype=torch.float64)
    turned, mirrored = LAYOUT.transform(x, math.radians(45)), LAYOUT.transform(x, 0.0, reflect=True)
    for name, expected, reflection in (
        ("xy", [0.0, math.sqrt(2)], [1.0, -1.0]),
        ("rod", [0.0, 1.0], [-1.0, 0.0]),
        ("z", [1.0], [1.0]),
        ("tilt", [0.0, math.sqrt(2)], [-1.0, 1.0]),
        ("yaw", [1.0], [-1.0]),
    ):
        assert turned[LAYOUT.slice(name)].tolist() == pytest.approx(expected, abs=1e-12)
        assert mirrored[LAYOUT.slice(name)].tolist() == reflection


def test_rotate_turns_each_row_by_its_own_angle():
    x, angle = torch.randn(5, 3, LAYOUT.dim, dtype=torch.float64), torch.arange(5) - 0.3
    turned = LAYOUT.rotate(x, angle)
    for i in range(5):
        expected = LAYOUT.transform(x[i], float(angle[i]))
        assert torch.allclose(turned[i], expected, atol=1e-6)


def test_equivariance_error_is_the_largest_relative_one():
    x = torch.randn(6, LAYOUT.dim)
    group = Group.parse("C4")

    def error(function):
        return equivariance_error(function, [x], [LAYOUT], LAYOUT, group)

    assert error(lambda v: 3 * v) < 1e-6
    # A constant c in the direction of xy: g c - c is largest for the half turn, 2 ||c||.
    constant = torch.zeros(LAYOUT.dim)
    constant[LAYOUT.slice("xy")] = 1.0
    assert error(lambda v: constant.expand_as(v)) == pytest.approx(2)
    assert error(torch.zeros_like) == 0


def test_escnn_missing(monkeypatch):
    monkeypatch.setitem(sys.modules, "escnn", None)
    with pytest.raises(UserError, match=r"pip install --no-deps escnn"):
        LAYOUT.field_type(Group.parse("C4"))


def test_escnn_without_lie_learn():
    """It imports lie-learn, which has no wheels for Python 3.13, and uses it for SO(3) alone."""
    need_escnn()
    code = """
import importlib.util, sys
find = importlib.util.find_spec
importlib.util.find_spec = lambda name: None if name == "lie_learn" else find(name)
sys.modules["lie_learn"] = None
from symsteer.errors import UserError
from symsteer.policies.geometry import escnn_package
group = escnn_package().group
print(group.cyclic_group(8).irrep(1).size)
try:
    group.so3_group(1).irrep(1)(group.so3_group(1).sample())
except UserError as error:
    print(error)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("2\nrepresentations of SO(3) need lie-learn")


def test_blocks_cover_the_vector_once():
    covered = torch.cat([torch.arange(LAYOUT.dim)[b] for b in LAYOUT.blocks])
    assert covered.tolist() == list(range(LAYOUT.dim))
    assert [b.stop - b.start for b in LAYOUT.blocks] == [2, 1, 2, 1, 2, 2, 2, 2]
    assert LAYOUT.block_index.tolist() == [0, 0, 1, 2, 2, 3, 4, 4, 5, 5, 6, 6, 7, 7]
    assert LAYOUT.invariant_mask().nonzero().flatten().tolist() == [2, 5]
    assert LAYOUT.invariant_mask(reflections=True).nonzero().flatten().tolist() == [2]


def test_json_round_trip_and_repeat():
    assert Layout.from_json(LAYOUT.to_json()) == LAYOUT
    chunk = LAYOUT.repeat(3)
    x = torch.randn(3, LAYOUT.dim, dtype=torch.float64)
    flat = chunk.transform(x.flatten(), 0.9, True).view(3, -1)
    assert torch.allclose(flat, LAYOUT.transform(x, 0.9, True))


@pytest.mark.parametrize(
    "mistake",
    [
        lambda: Layout([]),
        lambda: Layout([Field("a", 0), Field("a", 1)]),
        lambda: Field("a", -1),
        lambda: LAYOUT.slice("nothing"),
        lambda: Layout.from_json([{"name": "a"}]),
        lambda: Group.parse("E8"),
        lambda: Group.parse("D1"),
        lambda: Group.parse("SO2").order,
    ],
)
def test_mistakes_raise_user_errors(mistake):
    with pytest.raises(UserError):
        mistake()


@pytest.mark.parametrize("name", ["C1", "C8", "D4"])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_layers_commute_with_the_group(name, dtype, tolerance):
    torch.manual_seed(0)
    group = Group.parse(name)
    lift = Lift(LAYOUT, group, 5).to(dtype)
    linear = RegularLinear(group, 5, 6).to(dtype)
    project = Project(group, 6, LAYOUT).to(dtype)
    x = torch.randn(7, LAYOUT.dim, dtype=dtype)
    regular = lift(x)
    hidden = torch.relu(linear(regular))
    out = project(hidden)
    for index, (angle, reflect) in enumerate(group.elements):
        permutation = group.multiplication[group.inverse[index]]
        moved = LAYOUT.transform(x, angle, reflect)
        assert torch.allclose(lift(moved), regular[:, permutation], atol=tolerance)
        moved_hidden = torch.relu(linear(lift(moved)))
        assert torch.allclose(moved_hidden, hidden[:, permutation], atol=tolerance)
        moved_out = project(moved_hidden)
        assert torch.allclose(moved_out, LAYOUT.transform(out, angle, reflect), atol=tolerance)
