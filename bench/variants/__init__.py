"""Ways to break the symmetry, each with one strength in [0, 1].

- `VARIANTS`: all of them by name.
- `read(...)`: a text such as ``wind:0.5`` as frozen data, names checked.
- `build(...)`, `parse(...)`: the objects that act in an environment.
- `evaluation_variants(...)`, `highest_cost(...)`: what evaluation and returns need to know.

Importing this package is cheap: classes are imported when they are first used.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, TypeAlias

from symsteer.bench.variants.levels import with_numbers
from symsteer.errors import UserError
from symsteer.names import unknown
from symsteer.registry import Registry
from symsteer.variant import UNBROKEN, VariantSpec, parse_variant, specs_at

if TYPE_CHECKING:
    from symsteer.bench.variants.base import Variant

__all__ = ["VARIANTS", "build", "evaluation_variants", "highest_cost", "parse", "read"]

Place: TypeAlias = tuple[str, str]
"""Task and embodiment."""

VARIANTS: Registry[type[Variant]] = Registry(
    "variant",
    "symsteer.variants",
    {
        "gravity_tilt": "symsteer.bench.variants.gravity_tilt:GravityTilt",
        "wind": "symsteer.bench.variants.wind:Wind",
        "action_gain": "symsteer.bench.variants.action_gain:ActionGain",
        "actuator_offset": "symsteer.bench.variants.actuator_offset:ActuatorOffset",
        "friction_patch": "symsteer.bench.variants.friction_patch:FrictionPatch",
        "obstacle": "symsteer.bench.variants.obstacle:Obstacle",
        "perception_bias": "symsteer.bench.variants.perception_bias:PerceptionBias",
        "camera_rotation": "symsteer.bench.variants.camera_rotation:CameraRotation",
        "frame_offset": "symsteer.bench.variants.frame_offset:FrameOffset",
        "frame_rotation": "symsteer.bench.variants.frame_rotation:FrameRotation",
        "directional_reward": "symsteer.bench.variants.directional_reward:DirectionalReward",
        "spawn_sector": "symsteer.bench.variants.spawn_sector:SpawnSector",
        "observation_noise": "symsteer.bench.variants.observation_noise:ObservationNoise",
    },
    "symsteer.bench.variants.base:Variant",
)
"""All variants by name."""


def read(
    variant: str | Sequence[VariantSpec], strength: Any = None, place: Place | None = None
) -> tuple[VariantSpec, ...]:
    """Variants as data, with names that exist.

    Args:
        variant: ``none``, ``name:strength``, several of these joined by ``+``, or data.
        strength: of a single name that is written without one; a number, or one per environment.
        place: task and embodiment; with it the text may have levels, such as ``wind:hard``
            (:mod:`symsteer.bench.variants.levels`).

    Returns:
        All of them in the given order, those of strength 0 included.

    Raises:
        UserError: for an unknown or repeated name, a missing or malformed strength, one outside
            of [0, 1], or one without a name.
    """
    if isinstance(variant, str):
        variant = with_numbers(variant, *place) if place else variant
        return parse_variant(variant, strength, _check)
    if strength is not None:
        raise UserError(f"strength={strength} was given besides variants that have their own")
    specs = tuple(variant)
    for spec in specs:
        _check(spec.name)
    if len(specs) > 1 and any(isinstance(spec.strength, tuple) for spec in specs):
        raise UserError("one strength per environment is possible for a single variant only")
    return specs


def build(specs: Iterable[VariantSpec]) -> tuple[Variant, ...]:
    """The variants that do something: those of strength 0 are left out.

    Raises:
        UserError: if a class cannot be imported, or a strength depends on a run's budget.
    """
    specs = tuple(specs)
    for spec in specs:
        if spec.rise is not None:
            raise UserError(
                f"{spec.text} begins in the course of a run, but environments by themselves have "
                f"no budget; give {spec.at(1).text}, or use it with `symsteer run` or a suite"
            )
    return tuple(VARIANTS.get(spec.name)(spec) for spec in specs if not spec.changes_nothing)


def parse(
    variant: str | Sequence[VariantSpec], strength: Any = None, place: Place | None = None
) -> tuple[Variant, ...]:
    """:func:`read` and :func:`build` in one."""
    return build(read(variant, strength, place))


def evaluation_variants(
    specs: Iterable[VariantSpec], share: float = 1.0
) -> tuple[VariantSpec, ...]:
    """The variants in which agents are evaluated: those of training alone are left out.

    Args:
        specs: of a run.
        share: of the run's budget that is used.

    Raises:
        UserError: if a class cannot be imported.
    """
    present = specs_at(specs, share)
    return tuple(spec for spec in present if not VARIANTS.get(spec.name).training_only)


def highest_cost(variants: Iterable[Variant]) -> float:
    """The largest cost of a step before success: 1 and what the variants may add."""
    return 1.0 + sum(variant.highest_cost for variant in variants)


def _check(name: str) -> None:
    if name not in VARIANTS and ":" not in name:
        raise unknown("variant", name, [UNBROKEN, *VARIANTS])
