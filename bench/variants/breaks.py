"""What the variants of an environment do together, in the order in which they are named."""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import torch

from symsteer.bench.variants.base import Role, Variant, overriding
from symsteer.bench.variants.bodies import Frictions
from symsteer.policies.geometry import Layout

if TYPE_CHECKING:
    from mani_skill.utils.structs import Pose


class Breaks:
    """The variants of a task at work; a task without variants is left as it is.

    Args:
        env: the task, whose first scene is not yet built.
        variants: those that act in it.

    Attributes:
        cost: what the last control step cost besides the usual 1, ``[N]``; None if no variant
            makes steps costly.
    """

    def __init__(self, env: Any, variants: Sequence[Variant]):
        self.env, self.variants = env, variants
        for variant in variants:
            variant.env = env
        self.cost: torch.Tensor | None = None
        self._costly = overriding(variants, "extra_cost")
        self._distorting = overriding(variants, "observation")
        self._forces_held = False

    def load_scene(self) -> None:
        """Let the variants add to a scene that is being built."""
        for variant in self.variants:
            variant.load_scene()
        self._forces_held = False
        if self._costly:
            self.cost = torch.zeros(self.env.num_envs, device=self.env.device)
        self._frictions = Frictions(self.env, overriding(self.variants, "friction"))

    def reset(self, env_idx: torch.Tensor) -> None:
        """Draw strengths and change what was just placed in the environments ``env_idx``."""
        for variant in self.variants:
            variant.draw(env_idx)
            variant.reset(env_idx)
        if any(variant.low is not None for variant in self.variants):
            self._forces_held = False
            self.__dict__.pop("origin", None)

    def perceive(self, pose: Pose, role: Role) -> Pose:
        """A true pose as the observation reports it."""
        for variant in self.variants:
            pose = variant.perceive(pose, role)
        return pose

    def observation(
        self, fields: dict[str, torch.Tensor], layout: Layout
    ) -> dict[str, torch.Tensor]:
        """The fields ``[N, dim]`` of a layout as they are reported."""
        if not self._distorting:
            return fields
        values = torch.cat(list(fields.values()), dim=1)
        for variant in self._distorting:
            values = variant.observation(values, layout)
        return {name: values[:, layout.slice(name)] for name in fields}

    @functools.cached_property
    def origin(self) -> torch.Tensor:
        """Where the policy takes the workspace's centre to be, ``[N, 2]`` metres in the world."""
        center = torch.tensor(self.env.workspace_center, device=self.env.device)
        origin = center.expand(self.env.num_envs, 2)
        return sum((variant.origin() for variant in self.variants), origin)

    def action(self, commanded: torch.Tensor) -> torch.Tensor:
        """What is executed for the command ``[N, dim]``."""
        executed = self.env.body.bound(commanded)
        for variant in self.variants:
            executed = variant.action(executed)
        # Where no variant acts, the action must stay the same to the bit.
        return torch.where(self._active[:, None], executed, commanded)

    @functools.cached_property
    def _active(self) -> torch.Tensor:
        """Environments in which some variant has a strength above zero, ``[N]`` bool."""
        return torch.stack([variant.active for variant in self.variants]).any(dim=0)

    @contextmanager
    def step(self) -> Iterator[None]:
        """Push bodies, change friction and find the cost of the control step taken inside."""
        if not self._forces_held:
            self._hold_forces()
        self._frictions.update()
        before = self.env.agent.tcp_pose.p.clone() if self._costly else None
        yield
        if before is not None:
            moved = self.env.agent.tcp_pose.p - before
            self.cost = torch.stack([v.extra_cost(moved) for v in self._costly]).sum(dim=0)

    def _hold_forces(self) -> None:
        """Apply the forces, which depend on masses only, in all substeps from now on."""
        self._forces_held = True
        for body in self.env.moving_bodies:
            forces = [v.force(body) for v in overriding(self.variants, "force")]
            present = [force for force in forces if force is not None]
            if present:
                self.env.hold_force(body, torch.stack(present).sum(dim=0))
