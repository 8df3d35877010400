"""Networks that commute with every rotation: features are irreps of SO(2) or SO(3).

A feature tensor is ``[..., channels, dim]``; its last axis holds one irrep of every degree, 0 to
the highest. What commutes with rotations:

- linear maps within a degree. Pairs of SO(2) may also be turned: their weights are complex;
- the coupling of two features to a third, (l, m) -> k: products of complex numbers for SO(2), dot
  and cross products and their like for SO(3);
- factors that are invariant: gates, norms, FiLM. Only degree 0 is shifted (SDP, arXiv 2507.01723).

All is exact for any rotation, unlike nonlinearities on sampled rotations.
"""

from __future__ import annotations

import abc
import functools
import math
from collections.abc import Iterator

import torch
from torch import nn
from torch.nn import functional

from symsteer.errors import UserError
from symsteer.policies.geometry import Layout

EPSILON = 1e-6
"""Added to mean squares before a feature is divided by their root."""


class Irreps(abc.ABC):
    """The irreps of a rotation group up to a degree.

    Attributes:
        degrees: 0 to the highest.
        dims: numbers of an irrep of each degree.
        dim: their sum.
    """

    complex_weights: bool

    def __init__(self, dims: list[int]):
        self.dims, self.degrees, self.dim = dims, range(len(dims)), sum(dims)

    def degree(self, device: torch.device) -> torch.Tensor:
        """Degree of each number, ``[dim]`` int64."""
        return _degree(tuple(self.dims), device)

    def sizes(self, device: torch.device) -> torch.Tensor:
        """Numbers of an irrep of each degree."""
        return _sizes(tuple(self.dims), device)

    def slice(self, degree: int) -> slice:
        """Where an irrep lies in the last axis."""
        start = sum(self.dims[:degree])
        return slice(start, start + self.dims[degree])

    @functools.cached_property
    def couplings(self) -> torch.Tensor:
        """Every coupling (l, m) -> k as a trilinear form, ``[paths, dim, dim, dim]`` (k, l, m)."""
        forms = []
        for left in self.degrees:
            for right in self.degrees:
                for out in self.degrees:
                    for form in self._couple(left, right, out):
                        whole = torch.zeros(self.dim, self.dim, self.dim, dtype=torch.float64)
                        whole[self.slice(out), self.slice(left), self.slice(right)] = form
                        # Numbers of unit variance stay of about unit variance.
                        forms.append(whole * math.sqrt(self.dims[out]) / form.norm())
        return torch.stack(forms)

    @abc.abstractmethod
    def _couple(self, left: int, right: int, out: int) -> list[torch.Tensor]:
        """Forms ``[dims[out], dims[left], dims[right]]`` that commute with rotations."""

    def embedding(self, layout: Layout) -> dict[int, torch.Tensor]:
        """Where the irreps of a vector are in it: by degree, ``[count, dims[degree], layout.dim]``.

        Rows are orthonormal or 0. ``E @ x`` has the irreps of x, and ``E.T`` brings them back.

        Raises:
            UserError: if the vector has a higher degree.
        """
        places: dict[int, list[torch.Tensor]] = {}
        for degree, place in self._places(layout, torch.eye(layout.dim)):
            places.setdefault(degree, []).append(place)
        return {degree: torch.cat(same) for degree, same in places.items()}

    @abc.abstractmethod
    def _places(self, layout: Layout, unit: torch.Tensor) -> Iterator[tuple[int, torch.Tensor]]:
        """Degree and place of the irreps of each field; ``unit`` has the unit vectors."""


class PlanarIrreps(Irreps):
    """SO(2): frequencies 0 to the highest; pairs rotate by the frequency times the angle."""

    complex_weights = True

    def __init__(self, highest: int):
        super().__init__([1] + [2] * highest)

    def _couple(self, left: int, right: int, out: int) -> list[torch.Tensor]:
        forms = []
        for sign in (1, -1):
            if abs(left + sign * right) != out or (sign < 0 and not left * right):
                continue
            form = torch.zeros(2, 2, 2, dtype=torch.float64)
            for i, u in enumerate((1, 1j)):
                for j, v in enumerate((1, 1j)):
                    product = u * (v if sign > 0 else v.conjugate())
                    if left + sign * right < 0:
                        product = product.conjugate()
                    form[0, i, j], form[1, i, j] = product.real, product.imag
            forms.append(form[: self.dims[out], : self.dims[left], : self.dims[right]])
        return forms

    def _places(self, layout: Layout, unit: torch.Tensor) -> Iterator[tuple[int, torch.Tensor]]:
        for field in layout.fields:
            if field.frequency not in self.degrees:
                raise UserError(
                    f"the field {field.name!r} has frequency {field.frequency}, but this policy "
                    f"has frequencies up to {self.degrees[-1]}; raise max_frequency"
                )
            whole = unit[layout.slice(field.name)]
            yield field.frequency, whole.unflatten(0, (field.multiplicity, -1))


class SpatialIrreps(Irreps):
    """SO(3): degrees 0, 1 (vectors) and 2 (symmetric traceless matrices in an orthonormal basis).

    A planar vector without a vertical part has the vertical part 0, one of frequency 2 is a matrix
    in the plane. Higher frequencies have no place here and are left out.
    """

    complex_weights = False

    def __init__(self) -> None:
        super().__init__([1, 3, 5])

    @functools.cached_property
    def matrices(self) -> tuple[torch.Tensor, ...]:
        """Each degree as 3 x 3 matrices, ``[dims, 3, 3]``: of 1, antisymmetric, symmetric."""
        one = torch.eye(3, dtype=torch.float64)[None] / math.sqrt(3)
        cross = torch.zeros(3, 3, 3, dtype=torch.float64)
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            cross[i, k, j], cross[i, j, k] = 1 / math.sqrt(2), -1 / math.sqrt(2)
        flat = torch.zeros(5, 3, 3, dtype=torch.float64)
        for n, (i, j) in enumerate(((0, 1), (1, 2), (2, 0))):
            flat[n, i, j] = flat[n, j, i] = 1 / math.sqrt(2)
        flat[3] = torch.diag(flat.new_tensor([1, -1, 0])) / math.sqrt(2)
        flat[4] = torch.diag(flat.new_tensor([-1, -1, 2])) / math.sqrt(6)
        return one, cross, flat

    def harmonics(self, n: torch.Tensor) -> torch.Tensor:
        """Spherical harmonics of unit vectors ``[..., 3]``, ``[..., 9]``: 1, n, and n n^T."""
        second = torch.einsum("iab,...a,...b->...i", self.matrices[2].to(n), n, n)
        return torch.cat([torch.ones_like(n[..., :1]), n, second], dim=-1)

    def rotation(self, turn: torch.Tensor) -> torch.Tensor:
        """Wigner's matrices of rotations ``[B, 3, 3]`` in one, ``[B, 9, 9]``."""
        flat = self.matrices[2].to(turn)
        whole = turn.new_zeros(len(turn), self.dim, self.dim)
        whole[:, 0, 0], whole[:, 1:4, 1:4] = 1, turn
        whole[:, 4:, 4:] = torch.einsum("iab,Bac,jcd,Bbd->Bij", flat, turn, flat, turn)
        return whole

    def _couple(self, left: int, right: int, out: int) -> list[torch.Tensor]:
        if not abs(left - right) <= out <= left + right:
            return []
        # The product of two matrices commutes with rotations; its parts are of degree 0, 1 and 2.
        # The commutator has one kind of parts, the anticommutator the other.
        u, v, w = (self.matrices[degree] for degree in (left, right, out))
        product = torch.einsum("kab,iac,jcb->kij", w, u, v)
        return [product] if product.norm() > EPSILON else []

    def _places(self, layout: Layout, unit: torch.Tensor) -> Iterator[tuple[int, torch.Tensor]]:
        vectors = layout.spatial_vectors()
        for pair in vectors:
            yield 1, torch.cat([unit[layout.slice(name)] for name in pair])[None]
        for field in layout.fields:
            degree = field.frequency
            if degree not in self.degrees or any(field.name in pair for pair in vectors):
                continue
            planar = unit[layout.slice(field.name)].unflatten(0, (field.multiplicity, -1))
            place = planar.new_zeros(len(planar), self.dims[degree], layout.dim)
            # The parts of a planar irrep among those of the spatial one.
            place[:, ([0], [0, 1], [3, 0])[degree]] = planar
            yield degree, place


class EquivariantMap(nn.Module):
    """Linear within each degree, ``[..., in, dim] -> [..., out, dim]``, with a bias of degree 0."""

    def __init__(self, irreps: Irreps, inputs: int, outputs: int):
        super().__init__()
        self.irreps = irreps
        bound = math.sqrt(3 / inputs)
        parts = 2 if irreps.complex_weights else 1
        weight = torch.empty(parts, len(irreps.dims), outputs, inputs).uniform_(-bound, bound)
        self.weight = nn.Parameter(weight / math.sqrt(parts))
        self.bias = nn.Parameter(torch.zeros(outputs))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        # [dim, out, in]: the matrix of each number's degree.
        degree = self.irreps.degree(x.device)
        out = torch.einsum("doi,...id->...od", self.weight[0][degree], x)
        if self.irreps.complex_weights:
            out = out + torch.einsum("doi,...id->...od", self.weight[1][degree], quarter_turn(x))
        return torch.cat([out[..., :1] + self.bias[:, None], out[..., 1:]], dim=-1)


class _Ends(nn.Module):
    """Weights between the irreps of a vector and features, degree by degree."""

    def __init__(self, irreps: Irreps, layout: Layout, channels: int, enters: bool):
        super().__init__()
        self.irreps, self.channels = irreps, channels
        parts = 2 if irreps.complex_weights else 1
        self.weights = nn.ParameterDict()
        for degree, place in irreps.embedding(layout).items():
            shape = (channels, len(place)) if enters else (len(place), channels)
            count = shape[1] * parts
            bound = math.sqrt(3 / count) if enters else 1 / math.sqrt(count)
            weight = torch.empty(parts, *shape).uniform_(-bound, bound)
            self.weights[str(degree)] = nn.Parameter(weight)
            self.register_buffer(f"place{degree}", place, persistent=False)

    def mixed(self, key: str, block: torch.Tensor) -> torch.Tensor:
        """Irreps ``[..., n, dims[degree]]`` of one degree, mixed with each other."""
        weight = self.weights[key]
        mixed = weight[0] @ block
        if len(weight) > 1 and key != "0":
            mixed = mixed + weight[1] @ turned_pairs(block)
        return mixed


class Enter(_Ends):
    """A vector ``[..., dim]`` to features ``[..., channels, dim]``."""

    def __init__(self, irreps: Irreps, layout: Layout, channels: int):
        super().__init__(irreps, layout, channels, enters=True)

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        out = x.new_zeros(*x.shape[:-1], self.channels, self.irreps.dim)
        for key in self.weights:
            block = torch.einsum("ndv,...v->...nd", getattr(self, f"place{key}").to(x), x)
            out[..., self.irreps.slice(int(key))] = self.mixed(key, block)
        return out


class Leave(_Ends):
    """Features ``[..., channels, dim]`` to a vector ``[..., dim]``, with a bias of degree 0."""

    def __init__(self, irreps: Irreps, layout: Layout, channels: int):
        super().__init__(irreps, layout, channels, enters=False)
        self.layout = layout
        self.bias = nn.Parameter(torch.zeros(len(irreps.embedding(layout).get(0, ()))))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        out = x.new_zeros(*x.shape[:-2], self.layout.dim)
        for key in self.weights:
            mixed = self.mixed(key, x[..., self.irreps.slice(int(key))])
            if key == "0":
                mixed = mixed + self.bias[:, None]
            out = out + torch.einsum("ndv,...nd->...v", getattr(self, f"place{key}").to(x), mixed)
        return out


# Copied to a device once: a copy within a CUDA graph would end its recording.


@functools.lru_cache(maxsize=64)
def _sizes(dims: tuple[int, ...], device: torch.device) -> torch.Tensor:
    return torch.tensor(dims, device=device)


@functools.lru_cache(maxsize=64)
def _degree(dims: tuple[int, ...], device: torch.device) -> torch.Tensor:
    return torch.repeat_interleave(torch.arange(len(dims)), torch.tensor(dims)).to(device)


def turned_pairs(x: torch.Tensor) -> torch.Tensor:
    """Pairs in the last axis turned by 90 degrees."""
    return torch.stack([-x[..., 1], x[..., 0]], dim=-1)


def quarter_turn(x: torch.Tensor) -> torch.Tensor:
    """Pairs turned by 90 degrees, i times complex numbers; 0 for degree 0."""
    turned = turned_pairs(x[..., 1:].unflatten(-1, (-1, 2))).flatten(-2)
    return torch.cat([torch.zeros_like(x[..., :1]), turned], dim=-1)


class Norm(nn.Module):
    """Divides each degree by its root mean square over channels."""

    def __init__(self, irreps: Irreps, channels: int):
        super().__init__()
        self.irreps = irreps
        self.scale = nn.Parameter(torch.ones(channels, len(irreps.dims)))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        degree, sizes = self.irreps.degree(x.device), self.irreps.sizes(x.device)
        squares = x.square().mean(-2)
        means = torch.zeros_like(squares[..., : len(sizes)]).index_add(-1, degree, squares) / sizes
        return x * (means + EPSILON).rsqrt()[..., degree].unsqueeze(-2) * self.scale[:, degree]


class Coupling(nn.Module):
    """Two features, channel by channel, to one: every coupling with a weight for each channel."""

    forms: torch.Tensor

    def __init__(self, irreps: Irreps, channels: int):
        super().__init__()
        forms = irreps.couplings
        # Kept in float64, so that the network is exact in either precision.
        self.register_buffer("forms", forms, persistent=False)
        self.weight = nn.Parameter(torch.randn(channels, len(forms)) / math.sqrt(len(irreps.dims)))

    def _apply(self, fn, recurse=True):
        forms = self.forms
        super()._apply(fn, recurse)
        self.forms = forms.to(self.weight.device)
        return self

    def forward(self, u: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
        forms = torch.einsum("cp,pkij->cikj", self.weight, self.forms.to(self.weight.dtype))
        mixed = torch.einsum("...ci,cikj->...ckj", u, forms)
        return torch.einsum("...ckj,...cj->...ck", mixed, v)


class Gate(nn.Module):
    """SiLU of degree 0; the other degrees times a sigmoid of invariants, one for each channel."""

    def __init__(self, irreps: Irreps, channels: int):
        super().__init__()
        self.factors = nn.Linear(channels, channels * (len(irreps.dims) - 1))
        self.irreps = irreps

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        invariant = x[..., 0]
        factors = self.factors(invariant).sigmoid().unflatten(-1, (x.shape[-2], -1))
        degree = self.irreps.degree(x.device)[1:] - 1
        return torch.cat(
            [functional.silu(invariant)[..., None], x[..., 1:] * factors[..., degree]], dim=-1
        )


class Film(nn.Module):
    """Invariant conditions scale every degree and shift degree 0."""

    def __init__(self, irreps: Irreps, channels: int):
        super().__init__()
        self.irreps, self.channels = irreps, channels
        self.condition_dim = channels * (len(irreps.dims) + 1)

    def forward(self, x: torch.Tensor, condition: torch.Tensor) -> torch.Tensor:
        """Modulate ``x [B, channels, dim]`` by ``condition [B or 1, condition_dim]``."""
        values = condition.unflatten(-1, (self.channels, -1))
        scaled = x * (1 + values[..., self.irreps.degree(x.device)])
        return torch.cat([scaled[..., :1] + values[..., -1:], scaled[..., 1:]], dim=-1)
