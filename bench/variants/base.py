"""The base class of all variants.

A variant acts through its hooks, which the task calls inside ``env.step`` and ``env.reset``, so
that it acts for every user of ``gym.make``. At strength 0 no hook is called. Where strengths
differ between environments, a hook leaves those of strength 0 unchanged: they are the unbroken
task to the bit (on the CPU).
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import torch

from symsteer.bench.variants.noise import uniform
from symsteer.errors import UserError
from symsteer.policies.geometry import Layout
from symsteer.variant import VariantSpec

STREAM = 2**20
"""Of the strengths' random numbers; control steps have smaller ones."""

if TYPE_CHECKING:
    from mani_skill.utils.structs import Actor, Pose

Role = Literal["tool", "object", "goal"]
"""What a pose in the observation belongs to."""


class Variant:
    """One way to break the symmetry; the docstring of a subclass says what strength 1 means.

    Args:
        spec: its name and strength.

    Attributes:
        name: as in the registry.
        strength: one number, or one per environment as a tensor ``[N]``; the highest one, where
            each episode draws its own.
        low: None, or the lowest strength that an episode draws.
        env: the task, set before its first scene is built. A variant may use its ``num_envs``,
            ``device``, ``action_layout``, ``workspace_center``, ``spawn_extent``, ``manipulated``,
            ``moving_bodies``, ``elapsed_steps``, ``episode_key`` (a number for each episode that
            seeds noise, ``[N]`` int64) and ``body`` (``horizontal_step``, ``set_bias``), and
            ManiSkill's ``scene``, ``sim_config``, ``table_scene`` and ``agent``.
    """

    training_only: ClassVar[bool] = False
    """Whether agents are evaluated without it."""
    part_of_scene: ClassVar[bool] = False
    """Whether its strength cannot change while a scene exists."""

    env: Any

    def __init__(self, spec: VariantSpec):
        self.name = spec.name
        values = torch.as_tensor(spec.strength, dtype=torch.float32)
        self.strength: float | torch.Tensor = values if values.ndim else float(values)
        self.low = spec.low
        if self.low is not None and self.part_of_scene:
            raise UserError(
                f"{self.name} is built with the scene, so that its strength cannot be drawn anew "
                f"for each episode; give one number, e.g. {self.name}:0.5"
            )

    @functools.cached_property
    def amount(self) -> torch.Tensor:
        """Strength of each environment, ``[N]`` float32 on the environments' device."""
        strength = torch.as_tensor(self.strength, dtype=torch.float32, device=self.env.device)
        return strength.expand(self.env.num_envs).clone()

    @functools.cached_property
    def active(self) -> torch.Tensor:
        """Where the strength is, or may be, above zero, ``[N]`` bool."""
        return self.amount > 0 if self.low is None else torch.ones_like(self.amount) > 0

    def draw(self, env_idx: torch.Tensor) -> None:
        """New strengths of the environments ``env_idx``, each a function of its episode's key."""
        if self.low is None:
            return
        share = uniform(self.env.episode_key[env_idx], STREAM)
        self.amount[env_idx] = (self.low + (self.strength - self.low) * share).float()
        self.strengths_changed()

    def only_active(self, changed: torch.Tensor, original: torch.Tensor) -> torch.Tensor:
        """``changed [N, ...]`` where the strength is above zero, ``original`` elsewhere."""
        mask = self.active.view(-1, *[1] * (original.ndim - 1))
        return torch.where(mask, changed, original)

    def moved(self, pose: Pose, shift: torch.Tensor) -> Pose:
        """``pose`` shifted by ``shift [N, 2]`` metres where the strength is above zero."""
        p = pose.p + torch.nn.functional.pad(shift, (0, 1))
        return type(pose).create_from_pq(self.only_active(p, pose.p), pose.q)

    # ------------------------------------------------------------------- hooks

    def strengths_changed(self) -> None:
        """``amount`` has changed; what was computed from it must be computed anew."""

    def load_scene(self) -> None:
        """Add to a scene that is being built (robot and task are in it, nothing is simulated)."""

    def reset(self, env_idx: torch.Tensor) -> None:
        """Change what was just placed in the environments ``env_idx`` (sorted, ``[b]``).

        Poses are read for all environments and written for ``env_idx`` only.
        """

    def action(self, action: torch.Tensor) -> torch.Tensor:
        """What is executed for a bounded ``action [N, 7]``; by default the action itself."""
        return action

    def force(self, body: Actor) -> torch.Tensor | None:
        """Force on a dynamic body at its centre of mass, ``[N, 3]`` newtons in the world's axes.

        It is read once for each scene, and acts in every substep.
        """
        return None

    def friction(self, body: Actor) -> torch.Tensor | None:
        """What is added to the friction coefficients of a dynamic body or of the table, ``[N]``.

        It is read when a scene is built and before every control step.
        """
        return None

    def perceive(self, pose: Pose, role: Role) -> Pose:
        """What the observation reports for a true ``pose`` of N bodies; by default the pose."""
        return pose

    def observation(self, values: torch.Tensor, layout: Layout) -> torch.Tensor:
        """What is reported for a part ``values [N, layout.dim]`` of the observation."""
        return values

    def extra_cost(self, moved: torch.Tensor) -> torch.Tensor:
        """Cost of a control step in which the tool moved by ``moved [N, 3]`` metres, ``[N]``.

        It is subtracted from the reward of each step before success.
        """
        return moved.new_zeros(len(moved))

    @property
    def highest_cost(self) -> float:
        """The largest :meth:`extra_cost` that a step can have."""
        return 0.0

    def origin(self) -> torch.Tensor:
        """Where the policy takes the workspace's centre to be, from the true one, ``[N, 2]`` m."""
        return torch.zeros(self.env.num_envs, 2, device=self.env.device)


def overriding(variants: Iterable[Variant], hook: str) -> list[Variant]:
    """Those of ``variants`` that implement ``hook``."""
    return [v for v in variants if getattr(type(v), hook) is not getattr(Variant, hook)]
