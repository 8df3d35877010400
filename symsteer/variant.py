"""How a broken world is written: ``none``, ``name:strength``, or several joined by ``+``.

This is the only module that knows the spelling. Whether a name exists is for the registry of
variants to say (``symsteer.bench.variants``).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from symsteer.errors import UserError

UNBROKEN = "none"


@dataclass(frozen=True)
class VariantSpec:
    """One way to break the symmetry and how strongly.

    Attributes:
        name: of the variant.
        strength: in [0, 1]; one number, or one per environment.

    Raises:
        UserError: if a strength is not a number in [0, 1].
    """

    name: str
    strength: float | tuple[float, ...]

    def __post_init__(self) -> None:
        if not all(0 <= value <= 1 for value in self._strengths):
            raise UserError(
                f"the strength of variant {self.name!r} must lie in [0, 1], one number or one per "
                f"environment; it is {self.strength}"
            )

    @property
    def _strengths(self) -> tuple[float, ...]:
        return self.strength if isinstance(self.strength, tuple) else (self.strength,)

    @property
    def changes_nothing(self) -> bool:
        """Whether it has one strength, and that is 0."""
        return self.strength == 0

    @property
    def text(self) -> str:
        """``name:strength`` in the shortest form; strengths per environment as their mean."""
        mean = sum(self._strengths) / len(self._strengths)
        short = f"{mean:g}"
        exact = short if float(short) == mean or isinstance(self.strength, tuple) else repr(mean)
        return f"{self.name}:{exact}"


def parse_variant(
    text: str, strength: float | Sequence[float] | None = None
) -> tuple[VariantSpec, ...]:
    """Read a text such as ``action_gain:0.5+wind:1``.

    Args:
        text: ``none``, ``name:strength``, or several of these joined by ``+``.
        strength: of a single name that is written without one.

    Returns:
        Every part in the given order, those of strength 0 included.

    Raises:
        UserError: for a repeated name, a missing, repeated or malformed strength, one outside of
            [0, 1], or one without a name.
    """
    if text == UNBROKEN:
        if strength is not None and any(value != 0 for value in _as_tuple(strength)):
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
    specs: list[VariantSpec] = []
    for part in parts:
        # The name may be package.module:Class, so the strength follows the last colon.
        name, colon, number = _divide(part)
        if any(spec.name == name for spec in specs):
            raise UserError(f"the variant {name!r} is named twice in {text!r}; name it once")
        if colon and strength is not None:
            raise UserError(
                f"the strength of {name!r} is given twice, in {text!r} and as strength={strength}; "
                "give it once"
            )
        if colon:
            specs.append(VariantSpec(name, _number(name, number, text)))
        elif strength is not None and len(parts) == 1:
            values = _as_tuple(strength)
            single = isinstance(strength, int | float)
            specs.append(VariantSpec(name, values[0] if single else values))
        else:
            raise UserError(f"the variant {name!r} needs a strength in [0, 1], e.g. {name}:0.5")
    return tuple(specs)


def variant_text(specs: Iterable[VariantSpec]) -> str:
    """The text that :func:`parse_variant` reads, each strength in its shortest form."""
    return "+".join(spec.text for spec in specs) or UNBROKEN


def _divide(part: str) -> tuple[str, str, str]:
    """Name, colon and number of ``name:number``, ``name`` or ``package.module:Class:number``."""
    name, colon, number = part.rpartition(":")
    if not colon or (number[:1].isalpha() and "." in name):
        return part, "", ""
    return name, colon, number


def _as_tuple(strength: float | Sequence[float]) -> tuple[float, ...]:
    return (strength,) if isinstance(strength, int | float) else tuple(strength)


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
