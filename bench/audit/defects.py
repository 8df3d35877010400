"""The audit of one task, embodiment and variant: from simulated copies to defects.

docs/audit.md defines every number.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator

import numpy as np
import torch

from symsteer.bench.audit.estimates import (
    Array,
    bootstrap,
    energy_distance,
    gaussian_distance_squared,
    mean,
    ratio,
    root_excess,
    root_share,
)
from symsteer.bench.audit.measure import Copies, Experiment
from symsteer.bench.audit.result import (
    BIN,
    BODIES,
    LEAST_STATES,
    AuditResult,
    AuditSettings,
    Body,
    FieldDefect,
    MotionDefect,
    Square,
    Subset,
    check_group,
)
from symsteer.bench.audit.states import Visited, visit
from symsteer.bench.sim.trees import join_trees
from symsteer.bench.tasks import make
from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.tasks.features import is_direction
from symsteer.policies.contract import ChunkPolicy
from symsteer.policies.geometry import Layout

LEAST_DISPLACEMENT = 5e-4
"""A defect is not divided by a mean displacement (metres) below this."""

LEAST_SPREAD = 1e-3
"""A field whose spread over the resets is smaller does not enter their distance."""

LENGTHS = ("_xy", "_z", "_width", "_height", "_place", "_distance")
"""Ends of the names of observed lengths."""


def reference_task(settings: AuditSettings) -> SymmetricTask:
    """Make the unbroken task, with one environment for each state of a visitor, at most 64."""
    count = min(settings.count, 64)
    return make(settings.task, num_envs=count, embodiment=settings.embodiment)


def visit_all(
    reference: SymmetricTask, settings: AuditSettings, policy: ChunkPolicy | None
) -> Visited:
    """Sample the states of all visitors of ``settings``, in the unbroken task."""
    actors = {"expert": None, "policy": policy}
    return join_trees(
        [
            visit(reference, settings.count, settings.chunk, settings.seed, actors[visitor])
            for visitor in settings.visitors
        ]
    )


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
        policy: visited states, and encodes what cameras see; the result stores its content hash.

    Raises:
        UserError: see :meth:`AuditSettings.check`.
    """
    settings.check()
    begin, seed = time.perf_counter(), settings.seed
    group = check_group(settings.group)
    # What cameras see is compared as agents see it, after the encoder of the base policy.
    eyes = policy if reference.observation_layout.is_seen else None
    with Experiment(reference, settings.variant, group, visited, seed, eyes) as experiment:
        copies, resets = experiment.copies(), experiment.resets(settings.resets)
        centre, corners, layout = experiment.centre, experiment.corners, experiment.layout
    lengths = {body: copies.lengths(body, corners) for body in BODIES}
    rewards = {name: (value - value[:, :1]).abs() for name, value in copies.rewards.items()}
    apart = {name: copies.mean(value)[copies.compared] for name, value in rewards.items()}
    original, turned = _features(*resets, layout)
    distance, p_value = energy_distance(original, turned, seed)
    return AuditResult(
        settings=settings,
        base_policy=policy.content_hash()[:12] if policy is not None else None,
        states=len(visited),
        moving=int(visited.moving.sum()),
        unreachable=float((~copies.reached).double().mean()),
        origin_mm=(1e3 * float(centre[0]), 1e3 * float(centre[1])),
        dynamics=tuple(_dynamics(copies, lengths, seed)),
        reward={name: bootstrap(mean, value, seed=seed) for name, value in apart.items()},
        fields=tuple(_observation(copies, lengths["tool"]["horizontal"][1], layout, seed)),
        random_observation=copies.observations.shape[2] > 1,
        resets=distance,
        resets_p=p_value,
        map=tuple(_map(copies)),
        seconds=time.perf_counter() - begin,
    )


def _dynamics(
    copies: Copies, lengths: dict[Body, dict[str, tuple[Array, Array]]], seed: int
) -> Iterator[MotionDefect]:
    moving, policy = copies.moving.numpy(), copies.policy.numpy()
    subsets: dict[Subset, np.ndarray] = {
        "all": np.ones_like(moving),
        "expert": ~policy,
        "policy": policy,
        "still": ~moving,
        "moving": moving,
    }
    for body in BODIES:
        start, end = copies.poses[body].unbind(dim=2)
        distance = (end - end[:, :1])[..., :3].norm(dim=-1)
        angles = _angle(end[..., 3:], end[:, :1, 3:])
        millimetres = 1e3 * copies.mean(distance)
        degrees = np.degrees(copies.mean(angles))
        travelled = copies.mean((end - start)[..., :3].norm(dim=-1), first=0)
        for subset, chosen in subsets.items():
            keep = chosen & copies.compared
            if keep.sum() < LEAST_STATES or (subset != "all" and chosen.all()):
                continue
            relative = {
                direction: bootstrap(ratio, apart[keep], moved[keep], seed=seed)
                if moved[keep].mean() >= LEAST_DISPLACEMENT
                else None
                for direction, (apart, moved) in lengths[body].items()
            }
            picked = torch.as_tensor(keep)
            compared = distance[picked, 1:-1][copies.reached[picked, 1:]]
            yield MotionDefect(
                body=body,
                subset=subset,
                states=int(keep.sum()),
                horizontal=relative["horizontal"],
                vertical=relative["vertical"],
                mm=bootstrap(mean, millimetres[keep], seed=seed),
                degrees=bootstrap(mean, degrees[keep], seed=seed),
                displacement_mm=1e3 * float(travelled[keep].mean()),
                floor_mm=1e3 * float(distance[picked, -1].mean()),
                floor_degrees=math.degrees(float(angles[picked, -1].mean())),
                p95_mm=1e3 * float(compared.quantile(0.95)),
            )


def _angle(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Angle between orientations ``[..., 4]``, radians."""
    # By the chord, since the arc cosine is inaccurate for small angles.
    a, b = a / a.norm(dim=-1, keepdim=True), b / b.norm(dim=-1, keepdim=True)
    chord = torch.minimum((a - b).norm(dim=-1), (a + b).norm(dim=-1))
    return 4 * torch.asin((chord / 2).clamp(max=1.0))


def _observation(copies: Copies, moved: Array, layout: Layout, seed: int) -> Iterator[FieldDefect]:
    """Defects of all fields; ``moved [S]`` is the tool's horizontal motion."""
    travelled = moved[copies.compared]
    seen, again = copies.observations.numpy(), copies.observations_again.numpy()
    for field in layout.fields:
        here = layout.slice(field.name)
        original = seen[:, :1, :, here]
        squares = gaussian_distance_squared(seen[:, :, :, here], original)
        by_state = copies.mean(torch.as_tensor(squares))[copies.compared]
        # The distance between two sets of draws from the same distribution.
        chance = gaussian_distance_squared(again[:, :, here], original[:, 0])[copies.compared]
        if seen.shape[2] == 1:
            chance = np.zeros_like(chance)
        if not field.name.endswith(LENGTHS) or is_direction(field.name):
            value = bootstrap(root_excess, by_state, chance, seed=seed)
            yield FieldDefect(field.name, "", value, value)
            continue
        share = None
        if travelled.mean() >= LEAST_DISPLACEMENT:
            share = bootstrap(root_share, by_state, chance, travelled, seed=seed)
        value = bootstrap(root_excess, 1e6 * by_state, 1e6 * chance, seed=seed)
        yield FieldDefect(field.name, "mm", value, share)


def _features(original: torch.Tensor, turned: torch.Tensor, layout: Layout) -> list[Array]:
    """Features of resets, each field divided by its spread; those without a spread are left out.

    The spread is the root mean square over resets: about the mean for scalars, about zero (the mean
    over all rotations) for other fields.
    """
    scaled = []
    for field in layout.fields:
        here = layout.slice(field.name)
        values = original[:, here].numpy()
        centre = 0.0 if field.frequency else values.mean(axis=0)
        spread = float(np.sqrt(((values - centre) ** 2).sum(axis=-1).mean()))
        if spread >= LEAST_SPREAD:
            scaled.append([v[:, here].numpy() / spread for v in (original, turned)])
    return [np.concatenate(columns, axis=1) for columns in zip(*scaled, strict=True)]


def _map(copies: Copies) -> Iterator[Square]:
    for body in BODIES:
        departure = _departures(copies, body)[copies.reached].numpy()
        place = copies.place[body][copies.reached].numpy()
        index = np.floor(place / BIN).astype(int)
        squares, which, count = np.unique(index, axis=0, return_inverse=True, return_counts=True)
        sums = np.bincount(which.ravel(), weights=departure, minlength=len(squares))
        for (i, j), n, total in zip(squares, count, sums, strict=True):
            yield Square(
                body=body,
                x_mm=1e3 * BIN * (i + 0.5),
                y_mm=1e3 * BIN * (j + 0.5),
                copies=int(n),
                mm=1e3 * float(total) / int(n),
            )


def _departures(copies: Copies, body: str) -> torch.Tensor:
    """Distance of each copy of a body from the majority of its state's copies, metres, ``[S, G]``.

    The medoid is the copy that is closest to all others, so it belongs to the majority.
    """
    end = copies.poses[body][:, :-1, 1, :3]
    apart = (end[:, :, None] - end[:, None]).norm(dim=-1)
    cost = (apart * copies.reached.double()[:, None]).sum(dim=-1)
    medoid = torch.where(copies.reached, cost, torch.inf).argmin(dim=1)
    return apart[torch.arange(len(apart)), medoid]
