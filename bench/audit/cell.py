"""One cell of the audit: a task, an embodiment, a variant with its strength, and its numbers.

Every number is defined in docs/audit.md. A cell is plain data: :meth:`Cell.to_json` writes it and
:meth:`Cell.from_json` reads it.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import torch

from symsteer.bench.audit.estimates import (
    Array,
    Estimate,
    bootstrap,
    energy_distance,
    gaussian_distance_squared,
    mean,
    ratio,
    root_excess,
)
from symsteer.bench.audit.measure import Bench, Copies, Resets, check_group
from symsteer.bench.audit.states import Visited, visit
from symsteer.bench.sim.environment import Simulator
from symsteer.bench.tasks import check_embodiment, make, task_class
from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.variants import read
from symsteer.errors import UserError
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.geometry import Field, Layout
from symsteer.variant import file_name

VERSION = 1

Visitors = Literal["both", "expert", "policy"]

LEAST_DISPLACEMENT = 5e-4
"""Below this mean displacement (metres) a defect is not normalised by it."""

LEAST_SPREAD = 1e-3
"""A field whose spread over the states is smaller is not normalised by it."""

LEAST_STATES = 8
"""Subsets with fewer states are left out."""

BIN = 0.05
"""Side of a square of the map, metres."""


@dataclass(frozen=True)
class Settings:
    """What is measured, and how finely."""

    task: str = "PickCube-v1"
    embodiment: str = "floating"
    variant: str = "none"
    group: str = "C8"
    states: Visitors = "both"
    count: int = 32
    """States of each visitor."""
    chunk: int = 4
    """Steps of an action chunk."""
    resets: int = 256
    """Resets that are compared with as many turned ones."""
    seed: int = 0
    sim: Simulator = "cpu"

    def check(self) -> None:
        """Refuse what cannot be measured before anything is built.

        Raises:
            UserError: for an unknown task, embodiment, variant, group or simulator, or a number
                out of range.
        """
        task_class(self.task)
        check_embodiment(self.embodiment)
        read(self.variant)
        check_group(self.group)
        for name, least in (("count", LEAST_STATES), ("chunk", 1), ("resets", 16)):
            if getattr(self, name) < least:
                raise UserError(f"{name} is {getattr(self, name)}; it must be at least {least}")
        if not 0 <= self.seed < 2**32:
            raise UserError(f"seed is {self.seed}; it must lie in [0, 2^32)")
        if self.chunk > task_class(self.task).max_episode_steps:
            raise UserError(
                f"a chunk of {self.chunk} steps is longer than an episode of {self.task}; "
                "use a smaller --chunk"
            )
        if self.sim == "cuda" and not torch.cuda.is_available():
            raise UserError("--sim cuda was asked for, but torch finds no CUDA device; use cpu")

    @property
    def name(self) -> str:
        """A name for files."""
        return f"{self.task}-{self.embodiment}-{file_name(self.variant)}-{self.group}"

    @property
    def visitors(self) -> tuple[Literal["expert", "policy"], ...]:
        """Who visits the states."""
        return ("expert", "policy") if self.states == "both" else (self.states,)


@dataclass(frozen=True)
class Defect:
    """Dynamics defect of one body over one window for one subset of the states."""

    body: Literal["tool", "object"]
    window: Literal["step", "chunk"]
    subset: Literal["all", "expert", "policy", "still", "moving"]
    states: int
    relative: Estimate | None
    mm: Estimate
    degrees: Estimate
    displacement_mm: float
    floor_mm: float
    floor_degrees: float
    p95_mm: float


@dataclass(frozen=True)
class FieldDefect:
    """Observation defect of one field; ``value`` in mm where ``unit`` says so."""

    name: str
    unit: Literal["mm", ""]
    value: Estimate
    relative: float | None


@dataclass(frozen=True)
class Bin:
    """A square of the map: mean departure of its copies from the orbit's medoid over a chunk."""

    body: Literal["tool", "object"]
    x_mm: float
    y_mm: float
    copies: int
    mm: float


@dataclass(frozen=True)
class Cell:
    """All numbers of one cell."""

    settings: Settings
    base_policy: str | None
    """Start of the content hash of the policy that visited states."""
    states: int
    moving: int
    unreachable: float
    origin_mm: tuple[float, float]
    dynamics: tuple[Defect, ...]
    reward: dict[str, Estimate]
    observation: Estimate
    fields: tuple[FieldDefect, ...]
    random_observation: bool
    resets: Estimate
    resets_p: float
    map: tuple[Bin, ...] = ()
    seconds: float = 0.0
    version: int = field(default=VERSION)

    def defect(
        self,
        body: Literal["tool", "object"],
        window: Literal["step", "chunk"] = "step",
        subset: str = "all",
    ) -> Defect | None:
        """A row of the dynamics, or None if too few states are of that kind."""
        rows = (d for d in self.dynamics if (d.body, d.window, d.subset) == (body, window, subset))
        return next(rows, None)

    @property
    def worst_field(self) -> FieldDefect | None:
        """The position field with the largest defect."""
        positions = [f for f in self.fields if f.unit == "mm"]
        return max(positions, key=lambda f: f.value.value, default=None)

    def to_json(self) -> dict[str, Any]:
        """Nested plain data, numbers to six significant digits."""
        return _rounded(dataclasses.asdict(self))

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Cell:
        """Rebuild a cell.

        Raises:
            UserError: if the data are damaged or of another version.
        """
        try:
            if data["version"] != VERSION:
                raise UserError(
                    f"an audit of version {data['version']} was found, and this SymSteer reads "
                    f"version {VERSION}; run the audit again"
                )
            estimate = lambda d: None if d is None else Estimate(**d)  # noqa: E731
            numbers = ("relative", "mm", "degrees")
            return cls(
                **{
                    **data,
                    "settings": Settings(**data["settings"]),
                    "origin_mm": tuple(data["origin_mm"]),
                    "dynamics": tuple(
                        Defect(**{**d, **{k: estimate(d[k]) for k in numbers}})
                        for d in data["dynamics"]
                    ),
                    "reward": {k: Estimate(**v) for k, v in data["reward"].items()},
                    "observation": Estimate(**data["observation"]),
                    "fields": tuple(
                        FieldDefect(**{**f, "value": Estimate(**f["value"])})
                        for f in data["fields"]
                    ),
                    "resets": Estimate(**data["resets"]),
                    "map": tuple(Bin(**b) for b in data["map"]),
                }
            )
        except (KeyError, TypeError, AttributeError) as error:
            raise UserError(f"an audit file is damaged ({error!r}); run the audit again") from error


def visit_all(reference: SymmetricTask, settings: Settings, policy: ChunkPolicy | None) -> Visited:
    """The states of all visitors that ``settings`` names, in the unbroken task."""
    return Visited.join(
        [
            visit(
                reference,
                visitor,
                settings.count,
                settings.chunk,
                settings.seed,
                policy if visitor == "policy" else None,
            )
            for visitor in settings.visitors
        ]
    )


def reference_task(settings: Settings) -> SymmetricTask:
    """The unbroken task, with one environment for each state of a visitor."""
    return make(
        settings.task,
        num_envs=min(settings.count, 64),
        embodiment=settings.embodiment,
        sim=settings.sim,
    )


def audit(
    settings: Settings,
    reference: SymmetricTask,
    visited: Visited,
    policy: ChunkPolicy | None = None,
) -> Cell:
    """Measure one cell.

    Args:
        settings: what to measure.
        reference: the unbroken task, from :func:`reference_task`.
        visited: its states, from :func:`visit_all`; cells of a task share them.
        policy: the policy among the visitors, to be named in the result.
    """
    settings.check()
    begin = time.perf_counter()
    group = check_group(settings.group)
    bench = Bench(reference, settings.variant, group, visited, settings.seed, settings.sim)
    try:
        copies = bench.copies()
        resets = bench.resets(settings.resets)
        undistorted = bench.undistorted().numpy()
        centre = bench.centre
    finally:
        bench.close()
    layout = reference.observation_layout
    seed = settings.seed
    energy, p_value = _reset_defect(resets, layout, seed)
    observation, fields = _observation_defect(copies, undistorted, layout, seed)
    return Cell(
        settings=settings,
        base_policy=policy.content_hash()[:12] if policy is not None else None,
        states=len(visited),
        moving=int(visited.moving.sum()),
        unreachable=float((~copies.reached).double().mean()),
        origin_mm=(1e3 * float(centre[0]), 1e3 * float(centre[1])),
        dynamics=tuple(_dynamics(copies, seed)),
        reward=_reward_defect(copies, seed),
        observation=observation,
        fields=fields,
        random_observation=copies.observations.shape[2] > 1,
        resets=energy,
        resets_p=p_value,
        map=tuple(_map(copies)),
        seconds=time.perf_counter() - begin,
    )


# -------------------------------------------------------------------------- numbers


def _over_copies(values: torch.Tensor, copies: Copies, first: int = 1) -> Array:
    """Mean over the copies that exist from ``first`` on, ``[S, G] -> [S]``; nan without any."""
    mask = copies.reached[:, first:].double()
    total = (values[:, first:].double() * mask).sum(dim=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return total.numpy() / mask.sum(dim=1).numpy()


def _valid(rows: Array, copies: Copies) -> Array:
    """Which of ``rows [S]`` (bool) have a turned copy at all."""
    return rows & copies.reached[:, 1:].any(dim=1).numpy()


def _angle(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Angle between orientations ``[..., 4]``, radians."""
    # From the chord: exact also for the smallest angles, where the arc cosine is not.
    a, b = a / a.norm(dim=-1, keepdim=True), b / b.norm(dim=-1, keepdim=True)
    chord = torch.minimum((a - b).norm(dim=-1), (a + b).norm(dim=-1))
    return 4 * torch.asin((chord / 2).clamp(max=1.0))


def _dynamics(copies: Copies, seed: int) -> list[Defect]:
    moving, policy = copies.moving.numpy(), copies.policy.numpy()
    subsets = {
        "all": np.ones_like(moving),
        "expert": ~policy,
        "policy": policy,
        "still": ~moving,
        "moving": moving,
    }
    rows = []
    for body in ("tool", "object"):
        position, orientation = copies.positions[body], copies.quaternions[body]
        order = position.shape[1] - 1
        for index, window in ((1, "step"), (2, "chunk")):
            end, start = position[:, :, index], position[:, :, 0]
            apart = (end - end[:, :1]).norm(dim=-1)
            angles = _angle(orientation[:, :, index], orientation[:, :1, index])
            own = (end - start).norm(dim=-1)
            defect = _over_copies(apart[:, :order], copies)
            turn = np.degrees(_over_copies(angles[:, :order], copies))
            travelled = _over_copies(own[:, :order], copies, first=0)
            for subset, chosen in subsets.items():
                keep = _valid(chosen, copies)
                if keep.sum() < LEAST_STATES or (subset != "all" and chosen.all()):
                    continue
                picked = torch.as_tensor(keep)
                mask = copies.reached[picked, 1:]
                rows.append(
                    Defect(
                        body=body,  # type: ignore[arg-type]
                        window=window,  # type: ignore[arg-type]
                        subset=subset,  # type: ignore[arg-type]
                        states=int(keep.sum()),
                        relative=bootstrap(ratio, defect[keep], travelled[keep], seed=seed)
                        if travelled[keep].mean() >= LEAST_DISPLACEMENT
                        else None,
                        mm=bootstrap(mean, 1e3 * defect[keep], seed=seed),
                        degrees=bootstrap(mean, turn[keep], seed=seed),
                        displacement_mm=1e3 * float(travelled[keep].mean()),
                        floor_mm=1e3 * float(apart[picked, order].mean()),
                        floor_degrees=math.degrees(float(angles[picked, order].mean())),
                        p95_mm=1e3 * float(apart[picked, 1:order][mask].quantile(0.95)),
                    )
                )
    return rows


def _reward_defect(copies: Copies, seed: int) -> dict[str, Estimate]:
    keep = _valid(np.ones(len(copies.moving), dtype=bool), copies)
    values = {
        "cost": copies.function_cost,
        "dense": copies.function_dense,
        "outcome_cost_step": copies.cost[:, :, 0],
        "outcome_cost_chunk": copies.cost[:, :, 1],
        "outcome_dense_step": copies.dense[:, :, 0],
        "outcome_dense_chunk": copies.dense[:, :, 1],
    }
    return {
        name: bootstrap(mean, _over_copies((value - value[:, :1]).abs(), copies)[keep], seed=seed)
        for name, value in values.items()
    }


def in_metres(field: Field) -> bool:
    """Whether a field of the observation is a length: its name says so."""
    return field.name.endswith(("_xy", "_z", "_width", "_height"))


def _observation_defect(
    copies: Copies, undistorted: Array, layout: Layout, seed: int
) -> tuple[Estimate, tuple[FieldDefect, ...]]:
    keep = _valid(np.ones(len(copies.moving), dtype=bool), copies)
    seen, again = copies.observations.numpy(), copies.observations_again.numpy()
    total, chance, used = np.zeros(keep.sum()), np.zeros(keep.sum()), 0
    fields = []
    for part in layout.fields:
        here = layout.slice(part.name)
        own = seen[:, :1, :, here]
        squares = gaussian_distance_squared(seen[:, :, :, here], own)
        by_state = _over_copies(torch.as_tensor(squares), copies)[keep]
        # Two sets of draws of one and the same distribution are this far apart.
        floor = gaussian_distance_squared(again[:, :, here], own[:, 0])[keep]
        if seen.shape[2] == 1:
            floor = np.zeros_like(floor)
        spread = _spread(undistorted[keep][:, here], part)
        defect = bootstrap(root_excess, by_state, floor, seed=seed)
        metres = in_metres(part)
        scale = 1e3 if metres else 1.0
        fields.append(
            FieldDefect(
                name=part.name,
                unit="mm" if metres else "",
                value=Estimate(*(scale * v for v in dataclasses.astuple(defect))),
                relative=defect.value / spread if spread >= LEAST_SPREAD else None,
            )
        )
        if spread >= LEAST_SPREAD:
            total = total + by_state / spread**2
            chance = chance + floor / spread**2
            used += 1
    overall = bootstrap(root_excess, total / max(used, 1), chance / max(used, 1), seed=seed)
    return overall, tuple(fields)


def _spread(values: Array, part: Field) -> float:
    """Root mean square of a field over states, ``[S, dim]``: about zero for what rotations turn
    (the turned states' mean), about the mean for scalars."""
    centre = 0.0 if part.frequency else values.mean(axis=0)
    return float(np.sqrt(((values - centre) ** 2).sum(axis=-1).mean()))


def _reset_defect(resets: Resets, layout: Layout, seed: int) -> tuple[Estimate, float]:
    scaled = []
    for part in layout.fields:
        here = layout.slice(part.name)
        spread = _spread(resets.original[:, here].numpy(), part)
        if spread >= LEAST_SPREAD:
            scaled.append([v[:, here].numpy() / spread for v in (resets.original, resets.turned)])
    x, y = (np.concatenate(columns, axis=1) for columns in zip(*scaled, strict=True))
    return energy_distance(x, y, seed)


def _map(copies: Copies) -> list[Bin]:
    bins = []
    for body in ("tool", "object"):
        end = copies.positions[body][:, :-1, 2]
        apart = (end[:, :, None] - end[:, None]).norm(dim=-1)
        exists = copies.reached.double()
        # The medoid: the copy that is closest to all others, hence one of the majority.
        cost = (apart * exists[:, None]).sum(dim=-1)
        medoid = torch.where(copies.reached, cost, torch.inf).argmin(dim=1)
        departure = apart[torch.arange(len(apart)), medoid][copies.reached].numpy()
        place = copies.place[body][copies.reached].numpy()
        index = np.floor(place / BIN).astype(int)
        squares, which, count = np.unique(index, axis=0, return_inverse=True, return_counts=True)
        sums = np.bincount(which.ravel(), weights=departure, minlength=len(squares))
        for (i, j), n, total in zip(squares, count, sums, strict=True):
            bins.append(
                Bin(
                    body=body,  # type: ignore[arg-type]
                    x_mm=1e3 * BIN * (i + 0.5),
                    y_mm=1e3 * BIN * (j + 0.5),
                    copies=int(n),
                    mm=1e3 * float(total) / int(n),
                )
            )
    return bins


def _rounded(tree: Any) -> Any:
    if isinstance(tree, dict):
        return {key: _rounded(value) for key, value in tree.items()}
    if isinstance(tree, Sequence) and not isinstance(tree, str):
        return [_rounded(value) for value in tree]
    if isinstance(tree, float):
        return float(f"{tree:.6g}")
    return tree
