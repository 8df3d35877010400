"""The task ClutterPick-v1."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np
import sapien
import torch
from mani_skill.utils.building import actors
from mani_skill.utils.structs import Actor, Pose

from symsteer.bench.sim.rotations import wrap
from symsteer.bench.tasks.experts import (
    CLOSED,
    Intent,
    choose,
    finger_width,
    grasp_at,
    push,
    yaw_along,
)
from symsteer.bench.tasks.features import ahead_of, disc, flat_pose, left_of, yaw_up_to
from symsteer.bench.tasks.pick_cube import PickCube
from symsteer.policies.geometry import Field

BANDS = {"cube": (0.02, 4), "tcp": (0.03, 2)}
"""Of what the neighbours are seen from: how far apart its bands of distance are, in metres, and the
highest frequency of the bearing."""

COUNT = 3
"""Bands around each of them."""


def seen_around(at: torch.Tensor, spacing: float, highest: int) -> list[torch.Tensor]:
    """What a set of points looks like from the origin: sums over the points, so that their order
    does not matter.

    Point i at distance r and bearing b adds w(r) exp(i k b) for each band and each frequency k.
    The weights w are hats: in band j = 1, 2, ... they rise from 0 to 1 and fall to 0 again, at
    j - 1, j and j + 1 spacings.

    Args:
        at: where the points are, ``[N, points, 2]`` metres.
        spacing: of the bands, metres.
        highest: frequency.

    Returns:
        For each frequency from 0 on ``[N, COUNT * 1 or 2]``.
    """
    distance = at.norm(dim=2)
    bearing = torch.atan2(at[..., 1], at[..., 0])
    middle = spacing * torch.arange(1, COUNT + 1, device=at.device)
    weight = (1 - (distance[:, None] - middle[:, None]).abs() / spacing).clamp_min(0.0)
    parts = [weight.sum(dim=2)]
    for k in range(1, highest + 1):
        wave = torch.stack([(k * bearing).cos(), (k * bearing).sin()], dim=-1)
        parts.append((weight[..., None] * wave[:, None]).sum(dim=2).flatten(1))
    return parts


class ClutterPick(PickCube):
    """Free a cube of its neighbours by pushing, then pick it up.

    PickCube with three more cubes, which leave no room for the fingers at any face of the first one
    (docs/tasks/clutter-pick.md).
    """

    task_id = "ClutterPick-v1"
    max_episode_steps = 80
    task_fields: ClassVar[tuple[Field, ...]] = (
        *PickCube.task_fields,
        *(
            Field(f"around_{name}_{k}", k, COUNT)
            for name, (_, highest) in BANDS.items()
            for k in range(highest + 1)
        ),
    )
    neighbours_count = 3
    spawn_radius = 0.07
    spawn_extent = 0.15
    gaps = (0.003, 0.008)
    """From and to, metres between a neighbour and the cube."""
    bearing_jitter = math.radians(10)
    goal_heights = (0.1, 0.16)
    """From and to, metres from the table: above the neighbours."""
    noise_scale = 0.3
    finger = (0.00875, 0.0152)
    """Half the width and the thickness of a finger's tip, metres."""
    clearance = 0.003
    """What the expert leaves between a finger and a neighbour, metres."""
    push_aside = 0.01
    """How much further from the cube than a neighbour's centre the expert pushes, metres."""

    neighbours: list[Actor]

    def _load_scene(self, options: dict) -> None:
        super()._load_scene(options)
        self.neighbours = [
            actors.build_cube(
                self.scene,
                half_size=self.cube_half_size,
                color=[0.2, 0.4, 0.8, 1],
                name=f"neighbour_{i}",
                initial_pose=sapien.Pose(p=[0.1 * (i + 1), 0, self.cube_half_size]),
            )
            for i in range(self.neighbours_count)
        ]

    def _place_objects(self, rng: Any, count: int) -> None:
        n, half = self.neighbours_count, self.cube_half_size
        u = rng.uniform(size=7 + 2 * n)
        at, yaw = disc(u[:, :2], self.spawn_radius), 2 * np.pi * u[:, 2]
        self.cube.set_pose(flat_pose(at, half, yaw, self.device))
        low, high = self.goal_heights
        above = disc(u[:, 3:5], self.spawn_radius), low + (high - low) * u[:, 5:6]
        goal = torch.as_tensor(np.concatenate(above, axis=1), dtype=torch.float32)
        self.goal_site.set_pose(Pose.create_from_pq(goal.to(self.device)))
        for i, neighbour in enumerate(self.neighbours):
            jitter = self.bearing_jitter * (2 * u[:, 7 + i] - 1)
            bearing = 2 * np.pi * (u[:, 6] + i / n) + jitter
            # It faces the cube, which reaches that far into its direction.
            reach = half * (np.abs(np.cos(bearing - yaw)) + np.abs(np.sin(bearing - yaw)))
            low, high = self.gaps
            gap = low + (high - low) * u[:, 7 + n + i]
            place = at + (reach + gap + half)[:, None] * ahead_of(bearing)
            neighbour.set_pose(flat_pose(place, half, bearing, self.device))

    def _observe_task(self) -> dict[str, torch.Tensor]:
        at = torch.stack([self.seen(b.pose, "object").p[:, :2] for b in self.neighbours], dim=1)
        poses = {
            "cube": self.seen(self.cube.pose, "object"),
            "tcp": self.seen(self.agent.tcp_pose, "tool"),
        }
        around = {
            f"around_{name}_{k}": part
            for name, bands in BANDS.items()
            for k, part in enumerate(seen_around(at - poses[name].p[:, None, :2], *bands))
        }
        return {**super()._observe_task(), **around}

    # --------------------------------------------------------------------- expert

    def blocked(self) -> tuple[torch.Tensor, torch.Tensor]:
        """How far neighbours stand in the way of the fingers at the cube's two pairs of faces.

        Returns:
            The directions of the pairs, ``[N, 2, 2]`` unit vectors, and how far each neighbour has
            to go along the faces, ``[N, 2, neighbours]`` metres with a sign; 0: it is not in the
            way.
        """
        cube, half = self.cube.pose, self.cube_half_size
        faces = yaw_up_to(4, cube.q)
        first = torch.atan2(faces[:, 1], faces[:, 0]) / 4
        yaws = torch.stack([first, first + math.pi / 2], dim=1)
        axes = torch.stack([yaws.cos(), yaws.sin()], dim=2)
        sides = torch.stack([-yaws.sin(), yaws.cos()], dim=2)
        at = torch.stack([b.pose.p - cube.p for b in self.neighbours], dim=1)[..., :2]
        quads = torch.stack([yaw_up_to(4, b.pose.q) for b in self.neighbours], dim=1)
        turn = wrap(torch.atan2(quads[..., 1], quads[..., 0]) / 4 - first[:, None], math.pi / 2)
        wide = half * (turn.cos() + turn.sin().abs())[:, None]
        along, across = (torch.einsum("nic,nac->nai", at, d) for d in (axes, sides))
        width, thickness = self.finger
        missing = (width + wide + self.clearance - across.abs()).clamp_min(0.0)
        near = along.abs() < 2 * half + thickness + wide + self.clearance
        return axes, torch.where(across < 0, -missing, missing) * near

    def intent(self, offset: torch.Tensor) -> Intent:
        """Push aside what is in the way at the pair of faces with less of it, then pick."""
        tcp, cube = self.agent.tcp_pose.p, self.cube.pose.p
        rows = torch.arange(len(tcp), device=tcp.device)
        axes, missing = self.blocked()
        pair = missing.abs().sum(dim=2).argmin(dim=1)
        axis, missing = axes[rows, pair], missing[rows, pair]
        side = left_of(axis)
        # Of those in the way, the one whose far side is nearest to the tool.
        ahead = missing.sign()[..., None] * side[:, None]
        places = torch.stack([b.pose.p for b in self.neighbours], dim=1)
        level = places[..., :2] - tcp[:, None, :2]
        far = (level - 0.05 * ahead).norm(dim=2)
        which = torch.where(missing == 0, torch.inf, far).argmin(dim=1)
        blocked = (missing != 0).any(dim=1)
        place, ahead, level = places[rows, which], ahead[rows, which], level[rows, which]
        # Not further than it has to go, and on its outer half, so that it turns away from the cube:
        # else a finger or the neighbour drags the cube along.
        gap = (level * ahead).sum(dim=1) - self.finger[0] - self.cube_half_size
        step = (gap.clamp_min(0.0) + missing[rows, which].abs() + 0.003).clamp(max=0.03)
        out = ((place - cube)[:, :2] * axis).sum(dim=1, keepdim=True).sign() * axis
        place = torch.cat([place[:, :2] + self.push_aside * out, place[:, 2:]], dim=1)
        clearing = push(self, place + 0.3 * offset, ahead, 0.05, step[:, None])

        yaw = yaw_along(self, side)
        approach, held = grasp_at(self, cube + 0.3 * offset, cube, yaw, 2 * self.cube_half_size)
        carry = self.goal_site.pose.p - cube
        carry[:, :2] *= cube[:, 2:] > 0.06
        wanted = choose(
            held, Intent.to(carry, CLOSED), choose(blocked, replace(clearing, yaw=yaw), approach)
        )
        # Between cubes the tool goes up before it goes aside or opens, and comes down open.
        height, opening = tcp[:, 2] - cube[:, 2], finger_width(self) < 0.068
        rising = ~held & (height < 0.035) & (wanted.move[:, 2] > 0.02)
        waiting = ~blocked & opening & (height > 0.04) & (wanted.move[:, 2] < 0)
        vertical = wanted.move * wanted.move.new_tensor([0.0, 0.0, 1.0])
        wanted = choose(rising, Intent.to(vertical, CLOSED), wanted)
        return choose(waiting & ~held, replace(wanted, move=wanted.move - vertical), wanted)
