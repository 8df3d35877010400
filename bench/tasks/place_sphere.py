"""The task PlaceSphere-v1."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch
from mani_skill.envs.tasks.tabletop.place_sphere import PlaceSphereEnv

from symsteer.bench.tasks.base import SymmetricTask
from symsteer.bench.tasks.experts import CLOSED, Intent, choose, finger_width, funnel, grasp_at
from symsteer.bench.tasks.features import Thing, flat_pose, pair, vector_fields
from symsteer.policies.geometry import Field


class PlaceSphere(SymmetricTask, PlaceSphereEnv):
    """Put a sphere into a shallow bin and let go.

    ManiSkill's PlaceSphere-v1 with rotation-symmetric resets (docs/tasks/place-sphere.md). From
    11 cm on, open fingers around the sphere clear the bin at any yaw.
    """

    task_id = "PlaceSphere-v1"
    max_episode_steps = 50
    task_fields = (
        *vector_fields("sphere", "tcp_to_sphere"),
        Field("bin_xy", 1),
        Field("bin_yaw", 4),
        *vector_fields("sphere_to_bin"),
    )
    things: ClassVar[dict[str, Thing]] = {
        "sphere": Thing("obj"),
        "bin": Thing("bin", "goal", turns=4),
    }
    manipulated_name = "obj"
    spawn_radius = 0.07
    distance_range = (0.11, 0.18)
    spawn_extent = 0.2
    noise_scale = 0.3

    def _place_objects(self, rng: Any, count: int) -> None:
        u = rng.uniform(size=5)
        at_sphere, at_bin = pair(u, self.spawn_radius, self.distance_range)
        still, yaw = np.zeros(count), 2 * np.pi * u[:, 4]
        self.obj.set_pose(flat_pose(at_sphere, self.radius, still, self.device))
        self.bin.set_pose(flat_pose(at_bin, self.block_half_size[0], yaw, self.device))

    def intent(self, offset: torch.Tensor) -> Intent:
        """Grasp the sphere, carry it over the bin, lower it, let go, rise."""
        sphere, floor = self.obj.pose.p, self.bin.pose.p
        # Half of an offset: a sphere slips from fingers that close far from its middle. Above its
        # equator, so that the finger tips (9 mm below the tool centre point) clear the walls of
        # the bin.
        target = sphere + 0.5 * offset + sphere.new_tensor([0.0, 0.0, 0.005])
        any_yaw = torch.zeros_like(sphere[:, 0])
        approach, held = grasp_at(self, target, sphere, any_yaw, 2 * self.radius, haste=0.6)
        place = floor - sphere
        drop = place[:, 2] + self.radius + self.block_half_size[0]
        aside = place[:, :2].norm(dim=1)
        # Tips that touch a wall cannot open: let the sphere fall the last millimetres.
        wall = floor[:, 2] + self.block_half_size[0] + 2 * self.edge_block_half_size[2]
        lowest = wall + 0.012 - self.agent.tcp_pose.p[:, 2]
        rise = funnel(aside, 0.006, 4.0, 0.05)
        # Slowly at the end: a sphere that is let go in motion spins in the bin for seconds.
        move = torch.cat([place[:, :2], (drop.maximum(lowest) + rise)[:, None]], dim=1)
        last = move.norm(dim=1, keepdim=True) < 0.04
        carry = Intent.to(torch.where(last, 0.6 * move, move), CLOSED)
        opening = finger_width(self)
        # Once the fingers let go, the sphere may settle where the walls leave it.
        near = torch.where(opening > 0.045, 0.008, 0.006)
        placed = (aside < near) & (drop > -0.013)
        release = Intent.to_let_go(placed & (opening > 0.06))
        return choose(placed, release, choose(held, carry, approach))
