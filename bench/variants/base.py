"""What a symmetry-breaking variant is, and how its name is read.

To add one, write a file in this folder with a subclass of :class:`Variant` and list it in
:func:`registry`. A variant acts through its hooks, which the task calls inside ``env.step`` and
``env.reset``, so that it holds for every user of ``gym.make``. At strength 0 no hook is called at
all, and where strengths differ between environments a hook leaves those of strength 0 alone: they
are the unbroken task to the bit (on the CPU).
"""

from __future__ import annotations

import difflib
import functools
import math
from collections.abc import Iterable
from typing import TYPE_CHECKING, ClassVar, Literal

import torch

from symsteer.errors import UserError
from symsteer.policies.geometry import Layout

if TYPE_CHECKING:
    from mani_skill.utils.structs import Actor, Pose

    from symsteer.bench.tasks.base import SymmetricTask

Strength = float | torch.Tensor
"""One strength for all environments, or one each as a tensor ``[N]``; in [0, 1]."""


Role = Literal["tool", "object", "goal"]
"""What a pose in the observation belongs to."""

Component = Literal["dynamics", "reward", "observation", "resets"]
"""A part of the MDP that the audit measures on its own."""


class Variant:
    """One way to break the symmetry.

    Args:
        strength: in [0, 1]; what 1 means physically stands in the subclass's docstring.

    Attributes:
        env: the environments that it acts in, once :meth:`bind` was called.

    Raises:
        UserError: if the strength is not a number in [0, 1].
    """

    name: ClassVar[str]
    breaks: ClassVar[str]
    """Part of the MDP that it breaks, in words."""
    moves: ClassVar[frozenset[Component]]
    """The components of the audit that it breaks; actuation counts as dynamics."""
    where: ClassVar[Literal["everywhere", "in a region"]] = "everywhere"
    training_only: ClassVar[bool] = False
    """Whether agents are evaluated without it."""
    rotations_survive: ClassVar[bool] = False
    """Whether every rotation about the policy's origin remains a symmetry and only reflections
    are lost."""

    env: SymmetricTask

    def __init__(self, strength: Strength):
        try:
            values = torch.as_tensor(strength, dtype=torch.float32)
        except (TypeError, ValueError, RuntimeError):
            values = torch.tensor(math.nan)
        if values.ndim > 1 or not bool(((values >= 0) & (values <= 1)).all()):
            raise UserError(
                f"the strength of variant {self.name!r} must lie in [0, 1], one number or one per "
                f"environment; it is {strength}"
            )
        self.strength: Strength = values if values.ndim == 1 else float(values)

    def bind(self, env: SymmetricTask) -> None:
        """Take note of the environments that it acts in, before their first scene is built."""
        self.env = env

    @functools.cached_property
    def amount(self) -> torch.Tensor:
        """Strength of each environment, ``[N]`` float32 on the environments' device."""
        strength = torch.as_tensor(self.strength, dtype=torch.float32, device=self.env.device)
        return strength.expand(self.env.num_envs)

    @functools.cached_property
    def active(self) -> torch.Tensor:
        """Where the strength is above zero, ``[N]`` bool."""
        return self.amount > 0

    def only_active(self, changed: torch.Tensor, original: torch.Tensor) -> torch.Tensor:
        """``changed [N, ...]`` where the strength is above zero, ``original`` elsewhere."""
        mask = self.active.view(-1, *[1] * (original.ndim - 1))
        return torch.where(mask, changed, original)

    # ------------------------------------------------------------------- hooks

    def load_scene(self) -> None:
        """Add to a scene that is being built (robot and task are in it, nothing is simulated)."""

    def reset(self, env_idx: torch.Tensor) -> None:
        """Change what was just placed in the environments ``env_idx`` (sorted, ``[b]``).

        Poses are read for all environments and written for ``env_idx`` alone.
        """

    def action(self, action: torch.Tensor) -> torch.Tensor:
        """What is executed for a bounded ``action [N, 7]``; by default the action itself."""
        return action

    def force(self, body: Actor) -> torch.Tensor | None:
        """Force on a dynamic body at its centre of mass, ``[N, 3]`` newtons in the world's axes.

        It is asked for once a control step and acts in each of its substeps.
        """
        return None

    def friction(self, body: Actor) -> torch.Tensor | None:
        """What is added to the friction coefficients of a dynamic body or of the table, ``[N]``.

        It is asked for when a scene is built and before every control step.
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

    def origin(self) -> torch.Tensor | None:
        """Where the policy takes the workspace's centre to be, from the true one, ``[N, 2]`` m."""
        return None


def overriding(variants: Iterable[Variant], hook: str) -> list[Variant]:
    """Those of ``variants`` that implement ``hook``."""
    return [v for v in variants if getattr(type(v), hook) is not getattr(Variant, hook)]


def registry() -> dict[str, type[Variant]]:
    """All variants by name."""
    from symsteer.bench.variants.action_gain import ActionGain
    from symsteer.bench.variants.actuator_offset import ActuatorOffset
    from symsteer.bench.variants.directional_reward import DirectionalReward
    from symsteer.bench.variants.frame_offset import FrameOffset
    from symsteer.bench.variants.frame_rotation import FrameRotation
    from symsteer.bench.variants.friction_patch import FrictionPatch
    from symsteer.bench.variants.gravity_tilt import GravityTilt
    from symsteer.bench.variants.observation_noise import ObservationNoise
    from symsteer.bench.variants.obstacle import Obstacle
    from symsteer.bench.variants.perception_bias import PerceptionBias
    from symsteer.bench.variants.spawn_sector import SpawnSector
    from symsteer.bench.variants.wind import Wind

    variants = (
        GravityTilt,
        Wind,
        ActionGain,
        ActuatorOffset,
        FrictionPatch,
        Obstacle,
        PerceptionBias,
        FrameOffset,
        FrameRotation,
        DirectionalReward,
        SpawnSector,
        ObservationNoise,
    )
    return {variant.name: variant for variant in variants}


def variant_names() -> list[str]:
    """Names of all variants, sorted."""
    return sorted(registry())


def parse(text: str, strength: Strength | None = None) -> tuple[Variant, ...]:
    """Read ``none``, ``name:strength`` or several of them joined by ``+``.

    Args:
        text: e.g. ``action_gain:0.5``.
        strength: for a single name without a strength of its own.

    Returns:
        The variants whose strength is not zero, in the given order.

    Raises:
        UserError: for an unknown or repeated name, a missing or malformed strength, one out of
            [0, 1], or one without a name.
    """
    if text == "none":
        if strength is not None and bool((torch.as_tensor(strength) != 0).any()):
            raise UserError(
                f"strength={strength} was given without a variant; name one, e.g. "
                "variant='action_gain'"
            )
        return ()
    if "," in text or ";" in text:
        raise UserError(
            f"variants must be joined with +, e.g. action_gain:0.5+wind:0.5, not {text!r}"
        )
    parts = text.split("+")
    variants: list[Variant] = []
    for part in parts:
        name, colon, number = part.partition(":")
        if name not in registry():
            raise UserError(_unknown(name))
        if any(variant.name == name for variant in variants):
            raise UserError(f"the variant {name!r} is named twice in {text!r}; name it once")
        if colon and strength is not None:
            raise UserError(
                f"the strength of {name!r} is given twice, in {text!r} and as strength={strength}; "
                "give it once"
            )
        value = strength if not colon and len(parts) == 1 else _number(name, number, text)
        if value is None:
            raise UserError(f"the variant {name!r} needs a strength in [0, 1], e.g. {name}:0.5")
        variants.append(registry()[name](value))
    return tuple(v for v in variants if torch.is_tensor(v.strength) or v.strength != 0)


def evaluated(text: str) -> str:
    """The variants of ``text`` in which agents are evaluated: those of training alone left out.

    Raises:
        UserError: as :func:`parse`.
    """
    parse(text)
    kept = [part for part in text.split("+") if not _training_only(part)]
    return "+".join(kept) or "none"


def _training_only(part: str) -> bool:
    name = part.partition(":")[0]
    return name in registry() and registry()[name].training_only


def highest_cost(variants: Iterable[Variant]) -> float:
    """The largest cost of a step before success: 1 and what the variants may add."""
    return 1.0 + sum(variant.highest_cost for variant in variants)


def describe(variants: tuple[Variant, ...]) -> str:
    """The text that :func:`parse` reads; per-environment strengths appear as their mean."""
    if not variants:
        return "none"
    means = (float(torch.as_tensor(v.strength, dtype=torch.float32).mean()) for v in variants)
    return "+".join(f"{v.name}:{mean:g}" for v, mean in zip(variants, means, strict=True))


def _number(name: str, number: str, text: str) -> float:
    try:
        value = float(number)
    except ValueError:
        value = math.nan
    if math.isnan(value):
        raise UserError(
            f"no strength can be read for {name!r} in {text!r}; write name:number with a number "
            f"in [0, 1], e.g. {name}:0.5"
        )
    return value


def _unknown(name: str) -> str:
    names = ["none", *variant_names()]
    near = difflib.get_close_matches(name, names, n=1)
    hint = f"; did you mean {near[0]!r}?" if near else ""
    return f"there is no variant {name!r}{hint} Valid: {', '.join(names)}".replace("' V", "'; v")
