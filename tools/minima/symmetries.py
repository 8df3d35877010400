"""Symmetries of a policy's parameters: moves in parameter space that leave its function as it is.

The lifted networks (``edp``; over the trivial group ``plain`` and ``plain-augmented``) compute, for
the slice of each group element g, observation s, noise level t and noisy chunk x::

    seen(g)  = silu(W rho(g)^-1 s + b)                   regular fields, C channels
    told(g)  = silu(sum_h V(g^-1 h) seen(h) + c)         regular fields, C channels
    (scale, shift) of each block = A told(g) + a + B time,  time = silu(D levels(t) + d)
    h(g)     = L rho(g)^-1 x + l                         the stream
    h       <- h + O silu((1 + scale) (U norm(h) + u) + shift) + o       for each block
    chunk    = mean_g rho(g) (P silu(norm(h(g))) + p)

Discrete symmetries, those of :class:`Move`:

- *Permutations*: one of the channels of ``seen``, ``told`` and ``time`` each; one of the hidden
  features of each block, with the rows of A and B that scale and shift them; one of the stream, the
  same for all blocks, since their results are added up. The norms are over all features and keep
  it. A larger group of the stream, rotations, is lost in the last silu.
- *Shifts*: (R_u f)(g) = f(gu) commutes with the group's action and with silu. Each channel of
  ``seen`` has its own u: W_c -> W_c rho(u)^-1, V(v)_c -> V(vu)_c. Channels of ``told`` are mixed
  within a slice, and with the chunk's slice, so they have no shift of their own.
- *Turn*: one u for all slices at once: V(v) -> V(u^-1 v), L -> L rho(u)^-1, P -> rho(u) P, and p
  likewise.

Continuous symmetries: the affine part of a norm may move into U; U, u and 1 + scale, shift of a
hidden feature have a common factor, and u can move into shift; what is equal in all features
of the stream does not matter. :func:`balanced` chooses one point of each such orbit.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import torch
from scipy.optimize import linear_sum_assignment

from symsteer.errors import UserError
from symsteer.policies.geometry import Group, Layout
from symsteer.policies.symmetry.lifted import LiftedDenoiser
from symsteer.policies.training.denoising import DiffusionPolicy

Parts = dict[str, torch.Tensor]
"""Parameters by name; those of FiLM are split by block, ``condition.weight.0 [2, width, C]``."""

RESTARTS = 5
"""Starts of a search, the first from the identity."""

FILM = ("condition.weight", "condition.bias", "time_out.weight")


@dataclass(frozen=True)
class Move:
    """An element of the discrete symmetry group.

    Attributes:
        turn: index of the group element that all slices share.
        shifts: ``[C]``, index of the element of each channel of ``seen``.
        permutations: by kind of feature: feature i becomes feature ``permutation[i]``.
    """

    turn: int
    shifts: torch.Tensor
    permutations: Mapping[str, torch.Tensor]


@dataclass(frozen=True)
class Geometry:
    """What the symmetries of a network depend on.

    Attributes:
        group: of the slices.
        obs, chunk: geometry of the observation and of the flattened chunk.
        depth: number of blocks.
    """

    group: Group
    obs: Layout
    chunk: Layout
    depth: int
    axes: Mapping[str, tuple[str, ...]] = field(init=False)
    """Kind of the features along each axis of each part; empty where nothing is permuted."""

    def __post_init__(self) -> None:
        axes: dict[str, tuple[str, ...]] = {
            "obs_lift.weight": ("seen", ""),
            "obs_lift.bias": ("seen",),
            "obs_mix.weight": ("", "told", "seen"),
            "obs_mix.bias": ("told",),
            "time_in.weight": ("time", ""),
            "time_in.bias": ("time",),
            "chunk_lift.weight": ("stream", ""),
            "chunk_lift.bias": ("stream",),
            "slice_network.out_norm.weight": ("stream",),
            "slice_network.out_norm.bias": ("stream",),
            "project.weight": ("", "stream"),
            "project.bias": ("",),
        }
        for i in range(self.depth):
            hidden = f"hidden {i}"
            axes |= {
                f"condition.weight.{i}": ("", hidden, "told"),
                f"condition.bias.{i}": ("", hidden),
                f"time_out.weight.{i}": ("", hidden, "time"),
                f"slice_network.norms.{i}.weight": ("stream",),
                f"slice_network.norms.{i}.bias": ("stream",),
                f"slice_network.inner.{i}.weight": (hidden, "stream"),
                f"slice_network.inner.{i}.bias": (hidden,),
                f"slice_network.outer.{i}.weight": ("stream", hidden),
                f"slice_network.outer.{i}.bias": ("stream",),
            }
        object.__setattr__(self, "axes", axes)

    @classmethod
    def of(cls, policy: DiffusionPolicy) -> Geometry:
        """That of a policy.

        Raises:
            UserError: if its network is another one than the lifted MLP without points or pictures.
        """
        denoiser = policy.denoiser
        # A subclass may have other layers.
        other = type(denoiser) is not LiftedDenoiser or not denoiser.flat
        if other or policy.eyes:
            raise UserError(
                f"the parameter symmetries of this network of {policy.name} are not known; use "
                "edp, plain or plain-augmented with network=mlp and a task that is seen as poses"
            )
        chunk = policy.chunk_layout.repeat(policy.horizon)
        return cls(denoiser.group, policy.obs_layout, chunk, policy.options.depth)

    def rho(self, layout: Layout, like: torch.Tensor) -> torch.Tensor:
        """Matrices of the group on a layout, ``[order, dim, dim]``."""
        return self.group.representation(layout, like.dtype, like.device)

    def sizes(self, parts: Parts) -> dict[str, int]:
        """Number of features of each kind."""
        return {
            kind: size
            for name, kinds in self.axes.items()
            for kind, size in zip(kinds, parts[name].shape, strict=True)
            if kind
        }


def parts_of(policy: DiffusionPolicy, geometry: Geometry) -> Parts:
    """The parameters of a policy's network."""
    parts: Parts = {}
    for name, value in policy.denoiser.named_parameters():
        if name in FILM:
            blocks = value.detach().clone().unflatten(0, (geometry.depth, 2, -1))
            parts |= {f"{name}.{i}": block for i, block in enumerate(blocks)}
        else:
            parts[name] = value.detach().clone()
    return parts


def put(policy: DiffusionPolicy, parts: Parts, geometry: Geometry) -> None:
    """Give a policy's network these parameters."""
    with torch.no_grad():
        for name, parameter in policy.denoiser.named_parameters():
            if name in FILM:
                blocks = torch.stack([parts[f"{name}.{i}"] for i in range(geometry.depth)])
                parameter.copy_(blocks.flatten(0, 2))
            else:
                parameter.copy_(parts[name])
    policy.freeze()


def moved(parts: Parts, move: Move, geometry: Geometry) -> Parts:
    """The same function with other parameters: turned, then shifted, then permuted."""
    shifted = _shifted(_turned(parts, move.turn, geometry), move.shifts, geometry)
    return _permuted(shifted, move.permutations, geometry)


def _turned(parts: Parts, turn: int, geometry: Geometry) -> Parts:
    group, mix = geometry.group, parts["obs_mix.weight"]
    rho = geometry.rho(geometry.chunk, mix)[turn]
    return {
        **parts,
        "obs_mix.weight": mix[group.multiplication[group.inverse[turn]]],
        "chunk_lift.weight": parts["chunk_lift.weight"] @ rho.mT,
        "project.weight": rho @ parts["project.weight"],
        "project.bias": rho @ parts["project.bias"],
    }


def _shifted(parts: Parts, shifts: torch.Tensor, geometry: Geometry) -> Parts:
    lift, mix = parts["obs_lift.weight"], parts["obs_mix.weight"]
    rho = geometry.rho(geometry.obs, lift)[shifts]
    places = geometry.group.multiplication[:, shifts]
    return {
        **parts,
        "obs_lift.weight": torch.einsum("cd,ced->ce", lift, rho),
        "obs_mix.weight": mix.gather(0, places[:, None].expand_as(mix)),
    }


def _permuted(parts: Parts, permutations: Mapping[str, torch.Tensor], geometry: Geometry) -> Parts:
    result = dict(parts)
    for name, value in parts.items():
        for axis, kind in enumerate(geometry.axes[name]):
            if kind in permutations:
                value = value.index_select(axis, permutations[kind])
        result[name] = value
    return result


def random_move(parts: Parts, geometry: Geometry, generator: torch.Generator) -> Move:
    """A move drawn uniformly."""
    sizes, order = geometry.sizes(parts), geometry.group.order
    return Move(
        int(torch.randint(order, (), generator=generator)),
        torch.randint(order, (sizes["seen"],), generator=generator),
        {kind: torch.randperm(size, generator=generator) for kind, size in sizes.items()},
    )


def product(first: Parts, second: Parts) -> float:
    """The scalar product of all parameters; moves keep their norm."""
    return sum(float((first[name] * second[name]).sum()) for name in first)


def align(fixed: Parts, other: Parts, geometry: Geometry, group: bool = True) -> Move:
    """The move that brings ``other`` near ``fixed`` (weight matching, arXiv 2209.04836).

    One kind of features is matched at a time, all others as they are: the permutation with the
    largest scalar product, by linear assignment. A shift belongs to a pair of channels, so its best
    value is known before they are assigned. Kinds take turns in a random order until nothing is
    gained. All turns are tried, each from the identity and from random permutations.

    Args:
        fixed, other: parameters of two networks.
        geometry: of both.
        group: whether shifts and turns are allowed; else permutations alone.
    """
    generator = torch.Generator().manual_seed(0)
    sizes = geometry.sizes(other)
    best, most = None, -float("inf")
    elements = range(geometry.group.order if group else 1)
    for turn in elements:
        turned = _turned(other, turn, geometry)
        for restart in range(RESTARTS):
            start = {kind: torch.arange(size) for kind, size in sizes.items()}
            if restart:
                start = dict(random_move(other, geometry, generator).permutations)
            found, value = _climb(fixed, turned, start, elements, geometry, generator)
            if value > most:
                best, most = Move(turn, *found), value
    assert best is not None
    return best


def _climb(
    fixed: Parts,
    other: Parts,
    permutations: dict[str, torch.Tensor],
    elements: Sequence[int],
    geometry: Geometry,
    generator: torch.Generator,
) -> tuple[tuple[torch.Tensor, dict[str, torch.Tensor]], float]:
    """Shifts and permutations at which no single kind can be improved, and their product."""
    kinds = list(permutations)
    shifts = torch.zeros_like(permutations["seen"])
    under = [_shifted(other, shifts + u, geometry) for u in elements]
    now, value = other, -float("inf")
    while True:
        for number in torch.randperm(len(kinds), generator=generator).tolist():
            kind = kinds[number]
            rest = {name: own for name, own in permutations.items() if name != kind}
            # Channels of ``seen`` are compared under every shift.
            tables = [
                _similarity(fixed, candidate, kind, rest, geometry)
                for candidate in (under if kind == "seen" else [now])
            ]
            table, shift = torch.stack(tables).max(0)
            rows, columns = linear_sum_assignment(table.numpy(), maximize=True)
            permutations[kind] = torch.as_tensor(columns)
            if kind == "seen":
                shifts = shifts.index_copy(0, permutations[kind], shift[rows, columns])
                now = _shifted(other, shifts, geometry)
        last, value = value, product(fixed, _permuted(now, permutations, geometry))
        if value <= last + 1e-6 * abs(last):
            return (shifts, permutations), value


def _similarity(
    fixed: Parts,
    other: Parts,
    kind: str,
    rest: Mapping[str, torch.Tensor],
    geometry: Geometry,
) -> torch.Tensor:
    """Products of what belongs to feature i of one and feature j of the other network."""
    names = {name: kinds.index(kind) for name, kinds in geometry.axes.items() if kind in kinds}
    near = _permuted({name: other[name] for name in names}, rest, geometry)
    rows = [
        [p[name].movedim(axis, 0).reshape(p[name].shape[axis], -1) for name, axis in names.items()]
        for p in (fixed, near)
    ]
    mine, theirs = (torch.cat(features, dim=1) for features in rows)
    return mine @ theirs.mT


def blend(first: Parts, second: Parts, share: float) -> Parts:
    """The point of the straight line between two networks; ``share`` 0 is the first one."""
    return {name: first[name].lerp(second[name], share) for name in first}


def balanced(parts: Parts, geometry: Geometry) -> Parts:
    """The same function at one point of each continuous symmetry's orbit.

    Norms before a block have no affine part, U has rows of length 1, and u is 0.
    """
    result = dict(parts)
    for i in range(geometry.depth):
        norm, inner = f"slice_network.norms.{i}", f"slice_network.inner.{i}"
        weight = parts[f"{inner}.weight"] * parts[f"{norm}.weight"]
        bias = parts[f"{inner}.bias"] + parts[f"{inner}.weight"] @ parts[f"{norm}.bias"]
        length = weight.norm(dim=1)
        result |= {
            f"{norm}.weight": torch.ones_like(parts[f"{norm}.weight"]),
            f"{norm}.bias": torch.zeros_like(parts[f"{norm}.bias"]),
            f"{inner}.weight": weight / length[:, None],
            f"{inner}.bias": torch.zeros_like(bias),
        }
        for name in FILM:
            scale, shift = parts[f"{name}.{i}"]
            # Scales are relative to 1.
            one = 1.0 if name.endswith("bias") else 0.0
            factor, moving = (x.view(-1, *(1,) * (scale.dim() - 1)) for x in (length, bias))
            shift = shift + moving * (one + scale)
            result[f"{name}.{i}"] = torch.stack([factor * (one + scale) - one, shift])
    return result
