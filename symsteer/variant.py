"""The text of a variant: ``none``, ``name:strength``, or several joined by ``+``.

Only this module reads and writes this text. The registry of variants (``symsteer.bench.variants``)
knows which names exist.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from numbers import Real
from typing import Any

from symsteer.errors import UserError

UNBROKEN = "none"


@dataclass(frozen=True)
class VariantSpec:
    """A way to break the symmetry, and its strength.

    Attributes:
        name: of the variant.
        strength: in [0, 1]; one number, or one per environment.

    Raises:
        UserError: if a strength is not a number in [0, 1].
    """

    name: str
    strength: float | tuple[float, ...]

    def __post_init__(self) -> None:
        if not all(isinstance(value, Real) and 0 <= value <= 1 for value in self._strengths):
            raise UserError(
                f"the strength of variant {self.name!r} must lie in [0, 1], one number or one per "
                f"environment; it is {self.strength}"
            )

    @property
    def _strengths(self) -> tuple[float, ...]:
        return _as_tuple(self.strength)

    @property
    def changes_nothing(self) -> bool:
        """Whether its only strength is 0."""
        return self.strength == 0

    @property
    def text(self) -> str:
        """``name:strength`` in the shortest form; strengths per environment as their mean."""
        mean = sum(self._strengths) / len(self._strengths)
        short = f"{mean:g}"
        exact = short if float(short) == mean or isinstance(self.strength, tuple) else repr(mean)
        return f"{self.name}:{exact}"


def parse_variant(
    text: str, strength: Any = None, check: Callable[[str], Any] = str
) -> tuple[VariantSpec, ...]:
    """Read a text such as ``action_gain:0.5+wind:1``.

    Args:
        text: ``none``, ``name:strength``, or several of these joined by ``+``.
        strength: for a single name without a strength in the text; a number, or one per
            environment as a sequence, array or tensor.
        check: called with each name before its strength is read; raises for an unknown one.

    Returns:
        All parts in the given order, including those of strength 0.

    Raises:
        UserError: for a repeated name, a missing, repeated or malformed strength, one outside of
            [0, 1], or one without a name.
    """
    values = _plain(strength)
    if text == UNBROKEN:
        if any(value not in (None, 0) for value in _as_tuple(values)):
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
        check(name)
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
            specs.append(VariantSpec(name, values))
        else:
            raise UserError(f"the variant {name!r} needs a strength in [0, 1], e.g. {name}:0.5")
    return tuple(specs)


def variant_text(specs: Iterable[VariantSpec]) -> str:
    """The text that :func:`parse_variant` reads, each strength in its shortest form."""
    return "+".join(spec.text for spec in specs) or UNBROKEN


def lacks_strength(text: str) -> bool:
    """Whether a text is a single name without a strength, such as ``wind``."""
    return text != UNBROKEN and "+" not in text and not _divide(text)[1]


def with_strength(text: str, strength: float) -> str:
    """The text of names without strengths, each with this one; other texts stay as they are."""
    parts = text.split("+")
    if text == UNBROKEN or any(_divide(part)[1] for part in parts):
        return text
    return "+".join(f"{part}:{strength:g}" for part in parts) if strength else UNBROKEN


def file_name(text: str) -> str:
    """The text of a variant, or ``module:Class``, as a part of file names: without a colon."""
    return text.replace(":", "=")


def _divide(part: str) -> tuple[str, str, str]:
    """Name, colon and number of ``name:number``, ``name`` or ``package.module:Class:number``."""
    name, colon, number = part.rpartition(":")
    if not colon or (number[:1].isalpha() and "." in name):
        return part, "", ""
    return name, colon, number


def _plain(values: Any) -> Any:
    """A number, or a tuple of the numbers of a sequence, array or tensor."""
    values = values.tolist() if hasattr(values, "tolist") else values
    return tuple(values) if isinstance(values, list) else values


def _as_tuple(values: Any) -> tuple:
    return values if isinstance(values, tuple) else (values,)


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
