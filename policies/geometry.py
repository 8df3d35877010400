"""How vectors split into geometric parts, and how planar symmetries act on them.

A :class:`Layout` defines which numbers of an observation, an action or a noise vector are
horizontal vectors, scalars or higher frequencies. All other code gets slices and matrices from
the layout. It never uses fixed indices into such a vector.

A planar symmetry is a pair ``(angle, reflect)``: first the reflection (x, y) -> (x, -y) if
``reflect``, then the rotation by ``angle`` about the vertical axis. An irrep block of frequency
``k >= 1`` rotates by ``k * angle``; frequency 0 is a scalar. ``odd`` blocks also change sign under
reflections (yaw, axial vectors, mirrored rotation columns).
"""

from __future__ import annotations

import functools
import importlib.util
import itertools
import math
import re
import sys
import types
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, TypeAlias

import torch

from symsteer.errors import UserError
from symsteer.extras import extra
from symsteer.policies.picture import HAND, PICTURE, Picture

if TYPE_CHECKING:
    import escnn.group
    import escnn.nn


# Inside Layout the name `slice` is a method.
Slice: TypeAlias = slice


@dataclass(frozen=True)
class Field:
    """A named part of a vector: consecutive irrep blocks of the same kind.

    Args:
        name: unique within its layout.
        frequency: 0 for scalars (one number each), k >= 1 for pairs that rotate by ``k * angle``.
        multiplicity: number of blocks.
        odd: whether the blocks also change sign under reflections.
    """

    name: str
    frequency: int
    multiplicity: int = 1
    odd: bool = False

    def __post_init__(self) -> None:
        if self.frequency < 0 or self.multiplicity < 1:
            raise UserError(
                f"field {self.name!r} needs frequency >= 0 and multiplicity >= 1, "
                f"not {self.frequency} and {self.multiplicity}"
            )

    @property
    def block_dim(self) -> int:
        """Numbers in one irrep block: 1 for scalars, 2 for vectors."""
        return 1 if self.frequency == 0 else 2

    @property
    def dim(self) -> int:
        """Numbers in the whole field."""
        return self.block_dim * self.multiplicity


CLOUD = "cloud_"
"""Fields with this prefix are the coordinates of points, one block for each point."""


@dataclass(frozen=True)
class Cloud:
    """Where the points of a cloud lie in a vector.

    Attributes:
        point: geometry of one point.
        columns: ``[points, point.dim]`` int64.
        rest: geometry of the other fields.
        rest_columns: ``[rest.dim]`` int64.
    """

    point: Layout
    columns: torch.Tensor
    rest: Layout
    rest_columns: torch.Tensor


class Layout:
    """An ordered list of fields: the geometry of one vector.

    Raises:
        UserError: if the list is empty or a name occurs twice.
    """

    def __init__(self, fields: Sequence[Field]):
        self.fields = tuple(fields)
        if not self.fields:
            raise UserError("a layout needs at least one field")
        self._slices: dict[str, slice] = {}
        start = 0
        for field in self.fields:
            if field.name in self._slices:
                raise UserError(f"the field name {field.name!r} occurs twice in a layout")
            self._slices[field.name] = slice(start, start + field.dim)
            start += field.dim
        self.dim = start

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Layout) and self.fields == other.fields

    def __hash__(self) -> int:
        # Looked up several times in each update: hashing all fields takes longer than comparing.
        return hash((self.dim, len(self.fields)))

    def __repr__(self) -> str:
        parts = (f"{f.name}:{f.multiplicity}x{f.frequency}{'-' * f.odd}" for f in self.fields)
        return f"Layout({', '.join(parts)})"

    def slice(self, name: str) -> Slice:
        """Where the field lies in the vector.

        Raises:
            UserError: if the layout has no such field.
        """
        if name not in self._slices:
            raise UserError(f"no field {name!r} in this layout; it has {', '.join(self._slices)}")
        return self._slices[name]

    @functools.cached_property
    def blocks(self) -> tuple[Slice, ...]:
        """One slice per irrep block, in order; each of size 1 or 2."""
        return tuple(
            slice(start, start + field.block_dim)
            for field in self.fields
            for start in range(
                self._slices[field.name].start, self._slices[field.name].stop, field.block_dim
            )
        )

    @functools.cached_property
    def block_index(self) -> torch.Tensor:
        """The index of each number's irrep block, ``[dim]`` int64."""
        sizes = torch.tensor([block.stop - block.start for block in self.blocks])
        return torch.repeat_interleave(torch.arange(len(self.blocks)), sizes)

    @functools.cached_property
    def cloud(self) -> Cloud | None:
        """The cloud of points, if there is one: the fields ``cloud_...``.

        Raises:
            UserError: if these fields differ in their number of points, or there is nothing else.
        """
        seen = [field for field in self.fields if field.name.startswith(CLOUD)]
        if not seen:
            return None
        (count, *others) = dict.fromkeys(field.multiplicity for field in seen)
        if others or len(seen) == len(self.fields):
            raise UserError(
                "the fields cloud_... of a layout need the same number of points, and other fields "
                "beside them"
            )
        rest = [field for field in self.fields if field not in seen]
        index = torch.arange(self.dim)
        return Cloud(
            Layout([replace(f, name=f.name.removeprefix(CLOUD), multiplicity=1) for f in seen]),
            torch.cat([index[self.slice(f.name)].view(count, -1) for f in seen], dim=1),
            Layout(rest),
            torch.cat([index[self.slice(field.name)] for field in rest]),
        )

    @property
    def is_seen(self) -> bool:
        """Whether it has a cloud of points or a picture, which policies encode."""
        return bool(self.cloud or self.picture)

    @functools.cached_property
    def picture(self) -> Picture | None:
        """The picture, if there is one: the fields ``picture_...``, or ``hand_...``.

        Raises:
            UserError: if these fields are no scalars of the pixels of one square, or of two.
        """
        seen = [field for field in self.fields if field.name.startswith((PICTURE, HAND))]
        if not seen:
            return None
        prefix = HAND if seen[0].name.startswith(HAND) else PICTURE
        side = math.isqrt(seen[0].multiplicity)
        rest = [field for field in self.fields if field not in seen]
        kinds = {(f.frequency, f.odd, f.multiplicity, f.name.startswith(prefix)) for f in seen}
        if not rest or kinds != {(0, False, side**2, True)}:
            raise UserError(
                f"the fields {prefix}... of a layout need one scalar for each pixel of the same "
                "square, other fields beside them, and no other picture"
            )
        index = torch.arange(self.dim)
        return Picture(
            tuple(field.name.removeprefix(prefix) for field in seen),
            side,
            torch.cat([index[self.slice(field.name)] for field in seen]),
            Layout(rest),
            torch.cat([index[self.slice(field.name)] for field in rest]),
            prefix == HAND,
        )

    def split(self, at: int) -> tuple[tuple[Field, ...], tuple[Field, ...]]:
        """The fields of the first ``at`` numbers, and the others."""
        first = sum(self._slices[field.name].stop <= at for field in self.fields)
        return self.fields[:first], self.fields[first:]

    def spatial_vectors(self) -> list[tuple[str, str]]:
        """The pairs of fields that are vectors in space: horizontal part, then vertical part.

        They follow each other and are named ``NAME_xy`` and ``NAME_z`` (or ``xy`` and ``z``), or
        ``tilt`` and ``yaw``, the parts of a rotation.
        """
        pairs = []
        for first, second in itertools.pairwise(self.fields):
            stem, _, end = first.name.rpartition("[")
            name, instant = (stem, f"[{end}") if stem else (first.name, "")
            other = "yaw" if name == "tilt" else f"{name.removesuffix('xy')}z"
            named = name == "tilt" or name == "xy" or name.endswith(("_xy", ".xy"))
            kinds = (first.frequency, second.frequency, first.multiplicity, second.multiplicity)
            if named and second.name == other + instant and kinds == (1, 0, 1, 1):
                pairs.append((first.name, second.name))
        return pairs

    @property
    def spatial(self) -> Layout:
        """The same fields, with one block for each vector in space."""
        return _SpatialLayout(self.fields)

    def invariant_mask(self, reflections: bool = False) -> torch.Tensor:
        """Which numbers are invariant under rotations (and reflections), ``[dim]`` bool."""
        return torch.cat(
            [
                torch.full((f.dim,), f.frequency == 0 and not (reflections and f.odd))
                for f in self.fields
            ]
        )

    @property
    def block_means(self) -> torch.Tensor:
        """A matrix ``[dim, blocks]``: ``x @ block_means`` has the mean of each block."""
        membership = torch.nn.functional.one_hot(self.block_index)
        return membership / membership.sum(0)

    @classmethod
    def join(cls, **layouts: Layout) -> Layout:
        """The layout of several concatenated vectors."""
        parts = ((prefix, f) for prefix, layout in layouts.items() for f in layout.fields)
        return cls([replace(f, name=f"{prefix}.{f.name}") for prefix, f in parts])

    def repeat(self, count: int) -> Layout:
        """The layout of ``count`` concatenated vectors."""
        return Layout(
            [replace(f, name=f"{f.name}[{i}]") for i in range(count) for f in self.fields]
        )

    def matrix(
        self, angle: float, reflect: bool = False, dtype: torch.dtype = torch.float64
    ) -> torch.Tensor:
        """The representation of (angle, reflect), ``[dim, dim]``; angle in radians.

        It leaves the pixels of pictures as they are; :meth:`transform` turns them.
        """
        blocks = []
        for field in self.fields:
            sign = -1.0 if field.odd and reflect else 1.0
            if field.frequency == 0:
                block = torch.tensor([[sign]], dtype=torch.float64)
            else:
                c, s = _cos_sin(field.frequency * angle)
                flip = -1.0 if reflect else 1.0
                block = sign * torch.tensor([[c, -s * flip], [s, c * flip]], dtype=torch.float64)
            blocks += [block] * field.multiplicity
        return torch.block_diag(*blocks).to(dtype)

    def transform(self, x: torch.Tensor, angle: float, reflect: bool = False) -> torch.Tensor:
        """Act with (angle, reflect) on the last axis of ``x [..., dim]``.

        Pictures from above are interpolated, but for quarter turns.
        """
        if picture := self.picture:
            rest = picture.rest.transform(x[..., picture.rest_columns.to(x.device)], angle, reflect)
            return picture.changed(x, rest, picture.transform(picture.of(x), angle, reflect))
        return x @ self.matrix(angle, reflect, x.dtype).to(x.device).T

    def rotate(self, x: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
        """Rotate every row of ``x [N, ..., dim]`` by its own ``angle [N]`` (radians).

        Pictures are interpolated if they are from above.
        """
        if picture := self.picture:
            rows = x.flatten(0, -2)
            angle = angle.view(-1, *(1,) * (x.dim() - 2)).expand(x.shape[:-1]).flatten()
            rest = picture.rest.rotate(rows[:, picture.rest_columns.to(x.device)], angle)
            return picture.changed(rows, rest, picture.rotate(picture.of(rows), angle)).view_as(x)
        frequency, partner, sign = _quarter_turn(self, x.dtype, x.device)
        turn = angle.to(x).view(-1, *(1,) * (x.dim() - 1)) * frequency
        # x cos(k a) + J x sin(k a), where J rotates each vector by 90 degrees.
        return turn.cos() * x + turn.sin() * sign * x[..., partner]

    def turn(self, x: torch.Tensor, rotation: torch.Tensor) -> torch.Tensor:
        """Turn the vectors in space of every row of ``x [N, dim]`` by ``rotation [N, 3, 3]``."""
        turned = x.clone()
        for horizontal, vertical in self.spatial_vectors():
            parts = self.slice(horizontal), self.slice(vertical)
            vector = torch.cat([x[:, part] for part in parts], dim=1)
            # Sums of columns: a matrix product may round differently for another N.
            columns = (rotation[:, :, i] * vector[:, i : i + 1] for i in range(3))
            moved = next(columns) + next(columns) + next(columns)
            turned[:, parts[0]], turned[:, parts[1]] = moved[:, :2], moved[:, 2:]
        return turned

    def field_type(self, group: Group) -> escnn.nn.FieldType:
        """escnn's field type over a point, in the same basis as :meth:`matrix`.

        Raises:
            UserError: if escnn is not installed.
        """
        escnn, n = escnn_package(), group.rotations
        if n == 0:
            fibergroup = escnn.group.so2_group(max(1, *(f.frequency for f in self.fields)))
        else:
            kind = escnn.group.dihedral_group if group.reflections else escnn.group.cyclic_group
            fibergroup = kind(n)
        space = escnn.gspaces.no_base_space(fibergroup)
        representations = [
            _escnn_representation(fibergroup, group, field)
            for field in self.fields
            for _ in range(field.multiplicity)
        ]
        return escnn.nn.FieldType(space, representations)

    def to_json(self) -> list[dict[str, Any]]:
        """Plain data for JSON; :meth:`from_json` reads it."""
        return [asdict(field) for field in self.fields]

    @classmethod
    def from_json(cls, data: Sequence[Mapping[str, Any]]) -> Layout:
        """Rebuild a layout.

        Raises:
            UserError: if the data are not in the form of :meth:`to_json`.
        """
        try:
            fields = [
                Field(str(f["name"]), int(f["frequency"]), int(f["multiplicity"]), bool(f["odd"]))
                for f in data
            ]
        except (TypeError, KeyError, ValueError) as error:
            raise UserError(
                f"a layout description is damaged ({error!r}); it needs a list of "
                "{name, frequency, multiplicity, odd}"
            ) from error
        return cls(fields)


class _SpatialLayout(Layout):
    """A layout whose vectors in space are one block each."""

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _SpatialLayout) and super().__eq__(other)

    def __hash__(self) -> int:
        return hash((type(self), self.fields))

    @functools.cached_property
    def block_index(self) -> torch.Tensor:
        index = super().block_index.clone()
        for horizontal, vertical in self.spatial_vectors():
            index[self.slice(vertical)] = index[self.slice(horizontal)][0]
        # Numbers without gaps.
        return index.unique(return_inverse=True)[1]

    def invariant_mask(self, reflections: bool = False) -> torch.Tensor:
        mask = super().invariant_mask(reflections)
        for _, vertical in self.spatial_vectors():
            mask[self.slice(vertical)] = False
        return mask


@dataclass(frozen=True)
class Group:
    """A planar symmetry group: C_n, D_n (with the reflection of y), or SO(2).

    Args:
        rotations: n of C_n or D_n; 0 stands for SO(2).
        reflections: whether the group is dihedral.
    """

    rotations: int
    reflections: bool = False

    @classmethod
    def parse(cls, name: str) -> Group:
        """Read a name such as ``C8``, ``D4`` or ``SO2``.

        Raises:
            UserError: if it names no planar group.
        """
        if name == "SO2":
            return cls(0)
        match = re.fullmatch(r"([CD])([1-9]\d?)", name)
        if match is None or (match[1] == "D" and match[2] == "1"):
            raise UserError(
                f"{name!r} names no symmetry group; use C1 to C99, D2 to D99 or SO2, e.g. C8"
            )
        return cls(int(match[2]), match[1] == "D")

    @classmethod
    def parse_rotations(cls, name: str) -> Group:
        """Read the name of a finite group of rotations, C_n.

        Raises:
            UserError: if it names another group, or none.
        """
        group = cls.parse(name)
        if group.reflections or not group.rotations:
            raise UserError(
                "this policy commutes with rotations alone; its symmetry must be C_n, e.g. C8, not "
                f"{name}"
            )
        return group

    def __str__(self) -> str:
        kind = "D" if self.reflections else "C"
        return f"{kind}{self.rotations}" if self.rotations else "SO2"

    @property
    def order_of_rotations(self) -> int:
        """n of C_n or D_n.

        Raises:
            UserError: for SO(2), which is not finite.
        """
        if self.rotations == 0:
            raise UserError("SO2 is not finite; choose C_n or D_n here, e.g. C8")
        return self.rotations

    @property
    def order(self) -> int:
        """Number of elements."""
        return self.order_of_rotations * (2 if self.reflections else 1)

    @property
    def elements(self) -> tuple[tuple[float, bool], ...]:
        """All (angle in radians, reflect), the identity first, rotations before reflections."""
        n = self.order_of_rotations
        return tuple(
            (2 * math.pi * i / n, reflect)
            for reflect in ((False, True) if self.reflections else (False,))
            for i in range(n)
        )

    @property
    def multiplication(self) -> torch.Tensor:
        """``table[g, h]`` is the index of the product g h, ``[order, order]`` int64."""
        n = self.order_of_rotations
        index = torch.arange(self.order)
        rotation, flip = index % n, index // n
        turned = rotation[:, None] + torch.where(flip[:, None] == 1, -1, 1) * rotation[None, :]
        return turned % n + n * ((flip[:, None] + flip[None, :]) % 2)

    @property
    def inverse(self) -> torch.Tensor:
        """Index of each element's inverse, ``[order]`` int64."""
        return (self.multiplication == 0).int().argmax(dim=1)

    def representation(
        self,
        layout: Layout,
        dtype: torch.dtype = torch.float64,
        device: torch.device | str = "cpu",
    ) -> torch.Tensor:
        """Every element's matrix on ``layout``, ``[order, dim, dim]``; computed in float64."""
        return _representation(self, layout, dtype, torch.device(device))


@functools.lru_cache(maxsize=256)
def _representation(
    group: Group, layout: Layout, dtype: torch.dtype, device: torch.device
) -> torch.Tensor:
    matrices = [layout.matrix(angle, reflect) for angle, reflect in group.elements]
    return torch.stack(matrices).to(dtype=dtype, device=device)


def equivariance_error(
    function: Callable[..., torch.Tensor],
    inputs: Sequence[torch.Tensor],
    layouts: Sequence[Layout],
    output_layout: Layout,
    group: Group,
) -> float:
    """max over g of rms ||f(g x) - g f(x)|| / rms ||f(x)||.

    The outputs are compared in float64. The inputs are transformed in their own dtype.

    Args:
        function: f, called with the inputs as positional arguments.
        inputs: x, each ``[..., dim]`` of its layout; the group acts on the last axis.
        layouts: one for each input.
        output_layout: of the last axis of f's output.
        group: a finite group.
    """
    own = function(*inputs).double()
    size = own.square().mean().sqrt().clamp(min=1e-30)
    worst = 0.0
    for angle, reflect in group.elements:
        moved = function(
            *(n.transform(x, angle, reflect) for x, n in zip(inputs, layouts, strict=True))
        )
        gap = moved.double() - output_layout.transform(own, angle, reflect)
        worst = max(worst, (gap.square().mean().sqrt() / size).item())
    return worst


def group_average(
    function: Callable[..., torch.Tensor],
    inputs: Sequence[torch.Tensor],
    layouts: Sequence[Layout],
    output_layout: Layout,
    group: Group,
) -> torch.Tensor:
    """mean over g of g^-1 f(g x): an equivariant function from any function f.

    Arguments are those of :func:`equivariance_error`.
    """
    outputs = []
    for index, (angle, reflect) in enumerate(group.elements):
        out = function(
            *(n.transform(x, angle, reflect) for x, n in zip(inputs, layouts, strict=True))
        )
        # The matrices are orthogonal.
        outputs.append(out @ group.representation(output_layout, out.dtype, out.device)[index])
    return torch.stack(outputs).mean(0)


def escnn_package() -> Any:
    """The package ``escnn``, with ``escnn.nn``.

    escnn imports lie-learn for rotations in space alone. That package needs NumPy 1 and has no
    wheels for Python 3.13, so where it is missing a stand-in takes its place.

    Raises:
        UserError: if it cannot be imported.
    """
    if importlib.util.find_spec("lie_learn") is None:
        wigner = types.ModuleType("lie_learn.representations.SO3.wigner_d")
        vars(wigner)["wigner_D_matrix"] = _no_lie_learn
        sys.modules.setdefault(wigner.__name__, wigner)
    with extra("escnn", "this use of escnn"):
        import escnn.gspaces
        import escnn.nn
    return escnn


def _no_lie_learn(*args: Any, **options: Any) -> Any:
    raise UserError(
        "representations of SO(3) need lie-learn; install it with: pip install lie-learn"
    )


def _cos_sin(angle: float) -> tuple[float, float]:
    """Cosine and sine, exact at multiples of 90 degrees, so that C4 permutes the axes exactly."""
    quarter = angle / (math.pi / 2)
    if abs(quarter - round(quarter)) < 1e-12:
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[round(quarter) % 4]
    return math.cos(angle), math.sin(angle)


def _escnn_representation(
    fibergroup: escnn.group.Group, group: Group, field: Field
) -> escnn.group.Representation:
    """One irrep block of ``field`` as an escnn representation in the layout's basis."""
    import numpy as np

    n, k = group.rotations, field.frequency
    if n == 0:
        return fibergroup.irrep(k)
    k = k % n
    basis = np.eye(field.block_dim)
    conjugate = 2 * k > n
    if conjugate:
        k = n - k
    two_dimensional = 0 < 2 * k < n
    if field.frequency == 0:
        irreps = [(int(field.odd), 0)] if group.reflections else [(0,)]
    elif two_dimensional:
        irreps = [(1, k)] if group.reflections else [(k,)]
        if conjugate:
            basis = np.diag([1.0, -1.0])
        if group.reflections and field.odd:
            basis = np.array([[0.0, 1.0], [-1.0, 0.0]]) @ basis
    elif group.reflections:
        irreps = [(int(field.odd), k), (int(not field.odd), k)]
    else:
        irreps = [(k,), (k,)]
    name = f"frequency{field.frequency}{'odd' if field.odd else ''}"
    known = fibergroup.representations
    if name not in known:
        known[name] = escnn_package().group.Representation(fibergroup, name, irreps, basis)
    return known[name]


@functools.lru_cache(maxsize=256)
def _quarter_turn(
    layout: Layout, dtype: torch.dtype, device: torch.device
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Each number's frequency, and J as (index, sign): (J x)[i] = sign[i] x[index[i]]."""
    frequency = torch.cat([torch.full((f.dim,), float(f.frequency)) for f in layout.fields])
    partner, sign = torch.arange(layout.dim), torch.zeros(layout.dim)
    for block in layout.blocks:
        if block.stop - block.start == 2:
            partner[block] = partner[block].flip(0)
            sign[block] = torch.tensor([-1.0, 1.0])
    return frequency.to(device, dtype), partner.to(device), sign.to(device, dtype)
