"""The audit of one task, embodiment and variant: from simulated copies to defects.

docs/audit.md defines every number.
"""

from __future__ import annotations

import math
import time

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
    root_share,
)
from symsteer.bench.audit.measure import Copies, Experiment, Resets
from symsteer.bench.audit.result import (
    BIN,
    LEAST_STATES,
    AuditResult,
    AuditSettings,
    Bin,
    Defect,
    FieldDefect,
    check_group,
)
from symsteer.bench.audit.states import Visited, visit
from symsteer.bench.sim.rotations import quaternion_to_matrix
from symsteer.bench.sim.trees import join_trees
from symsteer.bench.tasks import make
from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.tasks.features import is_direction
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.geometry import Field, Layout

LEAST_DISPLACEMENT = 5e-4
"""A defect is not divided by a mean displacement (metres) below this."""

LEAST_SPREAD = 1e-3
"""A field whose spread over the resets is smaller does not enter their distance."""


def visit_all(
    reference: SymmetricTask, settings: AuditSettings, policy: ChunkPolicy | None
) -> Visited:
    """Sample the states of all visitors of ``settings``, in the unbroken task."""
    numbers = settings.count, settings.chunk, settings.seed
    actors = {"expert": None, "policy": policy}
    return join_trees([visit(reference, v, *numbers, actors[v]) for v in settings.visitors])


def reference_task(settings: AuditSettings) -> SymmetricTask:
    """Make the unbroken task, with one environment for each state of a visitor, at most 64."""
    count = min(settings.count, 64)
    return make(settings.task, num_envs=count, embodiment=settings.embodiment, sim=settings.sim)


def audit(
    settings: AuditSettings,
    reference: SymmetricTask,
    visited: Visited,
    policy: ChunkPolicy | None = None,
) -> AuditResult:
    """Measure the defects of one task, embodiment and variant.

    Args:
        settings: what to measure.
        reference: the unbroken task, from :func:`reference_task`.
        visited: its states, from :func:`visit_all`; the same for all variants of a task.
        policy: the policy that visited states; the result stores its content hash.

    Raises:
        UserError: see :meth:`AuditSettings.check`.
    """
    settings.check()
    begin = time.perf_counter()
    group = check_group(settings.group)
    experiment = Experiment(
        reference, settings.variant, group, visited, settings.seed, settings.sim
    )
    try:
        copies = experiment.copies()
        resets = experiment.resets(settings.resets)
        centre, box = experiment.centre, experiment.corners
    finally:
        experiment.close()
    layout = reference.observation_layout
    seed = settings.seed
    energy, p_value = _reset_defect(resets, layout, seed)
    return AuditResult(
        settings=settings,
        base_policy=policy.content_hash()[:12] if policy is not None else None,
        states=len(visited),
        moving=int(visited.moving.sum()),
        unreachable=float((~copies.reached).double().mean()),
        origin_mm=(1e3 * float(centre[0]), 1e3 * float(centre[1])),
        dynamics=tuple(_dynamics(copies, box, seed)),
        reward=_reward_defect(copies, seed),
        fields=_observation_defect(copies, box, layout, seed),
        random_observation=copies.observations.shape[2] > 1,
        resets=energy,
        resets_p=p_value,
        map=tuple(_map(copies)),
        seconds=time.perf_counter() - begin,
    )


# -------------------------------------------------------------------------- numbers


def _over_copies(values: torch.Tensor, copies: Copies, first: int = 1) -> Array:
    """Mean over the reached copies from ``first`` on, ``[S, G] -> [S]``; nan if there is none."""
    mask = copies.reached[:, first:].double()
    total = (values[:, first:].double() * mask).sum(dim=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        return total.numpy() / mask.sum(dim=1).numpy()


def _valid(rows: Array, copies: Copies) -> Array:
    """Those of ``rows [S]`` (bool) that have at least one turned copy."""
    return rows & copies.reached[:, 1:].any(dim=1).numpy()


def _angle(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Angle between orientations ``[..., 4]``, radians."""
    # By the chord, since the arc cosine is inaccurate for small angles.
    a, b = a / a.norm(dim=-1, keepdim=True), b / b.norm(dim=-1, keepdim=True)
    chord = torch.minimum((a - b).norm(dim=-1), (a + b).norm(dim=-1))
    return 4 * torch.asin((chord / 2).clamp(max=1.0))


def _lengths(
    copies: Copies, body: str, box: torch.Tensor
) -> dict[str, tuple[torch.Tensor, torch.Tensor]]:
    """Distances of copies from the original, and how far each copy moves, ``[S, G + 1]`` both.

    Horizontally and vertically: of the tool's centre point, or of the object's corners ``box``,
    mean over these.
    """
    points = copies.positions[body][..., None, :]
    if body == "object":
        points = points + box @ quaternion_to_matrix(copies.quaternions[body]).mT
    start, end = points.unbind(dim=2)
    pair = end - end[:, :1], end - start
    return {
        "horizontal": tuple(d[..., :2].norm(dim=-1).mean(dim=-1) for d in pair),  # type: ignore
        "vertical": tuple(d[..., 2].abs().mean(dim=-1) for d in pair),  # type: ignore
    }


def _dynamics(copies: Copies, box: torch.Tensor, seed: int) -> list[Defect]:
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
        angles = _angle(orientation[:, :, 1], orientation[:, :1, 1])
        distance = (position[:, :, 1] - position[:, :1, 1]).norm(dim=-1)
        travelled = _over_copies(
            (position[:, :order, 1] - position[:, :order, 0]).norm(dim=-1), copies, first=0
        )
        directions = {
            name: (
                _over_copies(between[:, :order], copies),
                _over_copies(moved[:, :order], copies, first=0),
            )
            for name, (between, moved) in _lengths(copies, body, box).items()
        }
        millimetres = 1e3 * _over_copies(distance[:, :order], copies)
        turn = np.degrees(_over_copies(angles[:, :order], copies))
        for subset, chosen in subsets.items():
            keep = _valid(chosen, copies)
            if keep.sum() < LEAST_STATES or (subset != "all" and chosen.all()):
                continue
            picked = torch.as_tensor(keep)
            mask = copies.reached[picked, 1:]
            relative = {
                name: bootstrap(ratio, between[keep], moved[keep], seed=seed)
                if moved[keep].mean() >= LEAST_DISPLACEMENT
                else None
                for name, (between, moved) in directions.items()
            }
            rows.append(
                Defect(
                    body=body,  # type: ignore[arg-type]
                    subset=subset,  # type: ignore[arg-type]
                    states=int(keep.sum()),
                    horizontal=relative["horizontal"],
                    vertical=relative["vertical"],
                    mm=bootstrap(mean, millimetres[keep], seed=seed),
                    degrees=bootstrap(mean, turn[keep], seed=seed),
                    displacement_mm=1e3 * float(travelled[keep].mean()),
                    floor_mm=1e3 * float(distance[picked, order].mean()),
                    floor_degrees=math.degrees(float(angles[picked, order].mean())),
                    p95_mm=1e3 * float(distance[picked, 1:order][mask].quantile(0.95)),
                )
            )
    return rows


def _reward_defect(copies: Copies, seed: int) -> dict[str, Estimate]:
    keep = _valid(np.ones(len(copies.moving), dtype=bool), copies)
    values = {
        "cost": copies.function_cost,
        "dense": copies.function_dense,
        "outcome_cost": copies.cost,
        "outcome_dense": copies.dense,
    }
    return {
        name: bootstrap(mean, _over_copies((value - value[:, :1]).abs(), copies)[keep], seed=seed)
        for name, value in values.items()
    }


def in_metres(field: Field) -> bool:
    """Whether a field of the observation is a length, by its name."""
    lengths = ("_xy", "_z", "_width", "_height")
    return field.name.endswith(lengths) and not is_direction(field.name)


def _observation_defect(
    copies: Copies, box: torch.Tensor, layout: Layout, seed: int
) -> tuple[FieldDefect, ...]:
    keep = _valid(np.ones(len(copies.moving), dtype=bool), copies)
    moved = _lengths(copies, "tool", box)["horizontal"][1][:, :-1]
    travelled = _over_copies(moved, copies, first=0)[keep]
    seen, again = copies.observations.numpy(), copies.observations_again.numpy()
    fields = []
    for part in layout.fields:
        here = layout.slice(part.name)
        own = seen[:, :1, :, here]
        squares = gaussian_distance_squared(seen[:, :, :, here], own)
        by_state = _over_copies(torch.as_tensor(squares), copies)[keep]
        # The distance between two sets of draws from the same distribution.
        chance = gaussian_distance_squared(again[:, :, here], own[:, 0])[keep]
        if seen.shape[2] == 1:
            chance = np.zeros_like(chance)
        metres = in_metres(part)
        scale = 1e6 if metres else 1.0
        value = bootstrap(root_excess, scale * by_state, scale * chance, seed=seed)
        relative: Estimate | None = value
        if metres:
            moving = travelled.mean() >= LEAST_DISPLACEMENT
            shares = (by_state, chance, travelled)
            relative = bootstrap(root_share, *shares, seed=seed) if moving else None
        fields.append(FieldDefect(part.name, "mm" if metres else "", value, relative))
    return tuple(fields)


def _spread(values: Array, part: Field) -> float:
    """Root mean square of a field ``[S, dim]`` over states: about the mean for scalars, about zero
    (the mean over all rotations) for other fields."""
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


def departures(copies: Copies, body: str) -> torch.Tensor:
    """Distance of each copy of a body from the majority of its state's copies, metres, ``[S, G]``.

    The medoid is the copy that is closest to all others, so it belongs to the majority.
    """
    end = copies.positions[body][:, :-1, 1]
    apart = (end[:, :, None] - end[:, None]).norm(dim=-1)
    cost = (apart * copies.reached.double()[:, None]).sum(dim=-1)
    medoid = torch.where(copies.reached, cost, torch.inf).argmin(dim=1)
    return apart[torch.arange(len(apart)), medoid]


def _map(copies: Copies) -> list[Bin]:
    bins = []
    for body in ("tool", "object"):
        departure = departures(copies, body)[copies.reached].numpy()
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
