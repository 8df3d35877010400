"""What a symmetry-breaking variant is, and how its name is read.

To add one, write a file in this folder with a subclass of :class:`Variant` and list it in
:func:`registry`. A variant acts through its hooks, which the task calls inside ``env.step``, so
that it holds for every user of ``gym.make``. At strength 0 no hook is called at all: the task is
the unbroken one to the bit.
"""

from __future__ import annotations

import difflib
import math
from typing import TYPE_CHECKING, ClassVar, Literal

import torch

from policies.errors import UserError

if TYPE_CHECKING:
    from mani_skill.utils.structs import Pose

Strength = float | torch.Tensor
"""One strength for all environments, or one each as a tensor ``[N]``; in [0, 1]."""


Role = Literal["tool", "object", "goal"]
"""What a pose in the observation belongs to."""


class Variant:
    """One way to break the symmetry.

    Args:
        strength: in [0, 1]; what 1 means physically stands in the subclass's docstring.

    Raises:
        UserError: if the strength is not a number in [0, 1].
    """

    name: ClassVar[str]
    breaks: ClassVar[str]
    """Part of the MDP that it breaks: dynamics, actuation, observation, reward, reachability or
    initial states."""

    def __init__(self, strength: Strength):
        try:
            values = torch.as_tensor(strength, dtype=torch.float32)
        except (TypeError, ValueError):
            values = torch.tensor(math.nan)
        if values.ndim > 1 or not bool(((values >= 0) & (values <= 1)).all()):
            raise UserError(
                f"the strength of variant {self.name!r} must lie in [0, 1], one number or one per "
                f"environment; it is {strength}"
            )
        self.strength: Strength = values if values.ndim == 1 else float(values)

    def action(self, action: torch.Tensor) -> torch.Tensor:
        """What is executed for a bounded ``action [N, 7]``; by default the action itself."""
        return action

    def perceive(self, pose: Pose, role: Role) -> Pose:
        """What the observation reports for a true ``pose`` of N bodies; by default the pose."""
        return pose


def registry() -> dict[str, type[Variant]]:
    """All variants by name."""
    from bench.variants.action_gain import ActionGain

    return {variant.name: variant for variant in (ActionGain,)}


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
        UserError: for an unknown or repeated name, a missing or malformed strength, or one out
            of [0, 1].
    """
    if text == "none":
        return ()
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
