"""The text of a variant: ``none``, ``name:strength``, or several joined by ``+``.

| text | strength |
|---|---|
| ``wind:0.5`` | 0.5 |
| ``wind:0.2..0.8`` | uniform in [0.2, 0.8], drawn anew for each episode |
| ``wind:1@0.5`` | 0, and 1 from half of the run's budget on |
| ``wind:1@0.25..0.75`` | 0, rising from a quarter of the budget on to 1 at three quarters |

Only this module reads and writes this text. The registry of variants (``symsteer.bench.variants``)
knows which names exist.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
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
        low: None, or the lowest strength of an episode, where each draws its own; ``strength`` is
            then the highest.
        rise: None, or the shares of a run's budget between which the strength rises from 0; equal
            ones for a step.

    Raises:
        UserError: if a strength is not a number in [0, 1], or a range is empty.
    """

    name: str
    strength: float | tuple[float, ...]
    low: float | None = None
    rise: tuple[float, float] | None = None

    def __post_init__(self) -> None:
        strengths: tuple[float, ...] = _as_tuple(self.strength)
        if not all(isinstance(value, Real) and 0 <= value <= 1 for value in strengths):
            raise UserError(
                f"the strength of variant {self.name!r} must lie in [0, 1], one number or one per "
                f"environment; it is {self.strength}"
            )
        if self.low is not None and not 0 <= self.low < strengths[0]:
            raise UserError(
                f"the strengths of variant {self.name!r} must be a range such as 0.2..0.8 within "
                f"[0, 1]; they are {self.low:g}..{self.strength}"
            )
        if self.rise is not None and not 0 < self.rise[0] <= self.rise[1] <= 1:
            raise UserError(
                f"variant {self.name!r} must begin within the budget, at a share in (0, 1], and "
                f"reach its strength by its end, e.g. {self.name}:1@0.5 or {self.name}:1@0.25..0.75"
            )

    @property
    def changes_nothing(self) -> bool:
        """Whether its only strength is 0."""
        return self.strength == 0

    @property
    def is_constant(self) -> bool:
        """Whether the strength is the same in all episodes of a run."""
        return self.low is None and self.rise is None

    def at(self, share: float) -> VariantSpec:
        """What it is when ``share`` of a run's budget is used."""
        if self.rise is None:
            return self
        begin, end = self.rise
        if share >= end:
            return replace(self, rise=None)
        factor = max(0.0, share - begin) / (end - begin) if end > begin else 0.0
        if not factor:
            return VariantSpec(self.name, 0.0)
        assert not isinstance(self.strength, tuple)
        low = None if self.low is None else self.low * factor
        return replace(self, strength=self.strength * factor, low=low, rise=None)

    @property
    def text(self) -> str:
        """The shortest form; strengths per environment as their mean."""
        if isinstance(self.strength, tuple):
            return f"{self.name}:{sum(self.strength) / len(self.strength):g}"
        rise = () if self.rise is None else tuple(dict.fromkeys(self.rise))
        strengths = (self.strength,) if self.low is None else (self.low, self.strength)
        when = f"@{_range_text(rise)}" if rise else ""
        return f"{self.name}:{_range_text(strengths)}{when}"


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
    parts = parts_of(text)
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
            specs.append(_spec(name, number, text))
        elif strength is not None and len(parts) == 1:
            specs.append(VariantSpec(name, values))
        else:
            raise UserError(f"the variant {name!r} needs a strength in [0, 1], e.g. {name}:0.5")
    return tuple(specs)


def parts_of(text: str) -> list[str]:
    """The parts that ``+`` joins; a `UserError` if ``none`` is one of them."""
    parts = text.split("+")
    if text != UNBROKEN and any(part.partition(":")[0] == UNBROKEN for part in parts):
        raise UserError(
            f"none is the unbroken task and must stand alone, without a strength; leave it out of "
            f"{text!r}, or write none"
        )
    return parts


def specs_at(specs: Iterable[VariantSpec], share: float) -> tuple[VariantSpec, ...]:
    """What variants are when ``share`` of a run's budget is used, without those that do nothing."""
    present = (spec.at(share) for spec in specs)
    return tuple(spec for spec in present if not spec.changes_nothing)


def variant_text(specs: Iterable[VariantSpec]) -> str:
    """The text that :func:`parse_variant` reads, each strength in its shortest form."""
    return "+".join(spec.text for spec in specs) or UNBROKEN


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


def _range_text(values: Iterable[float]) -> str:
    """Numbers in their shortest form, joined by dots."""
    texts = (f"{value:g}" if float(f"{value:g}") == value else repr(value) for value in values)
    return "..".join(texts)


def _spec(name: str, number: str, text: str) -> VariantSpec:
    """The strength ``S`` or ``LOW..HIGH``, followed by nothing, ``@T`` or ``@T..U``."""
    strengths, at, shares = number.partition("@")
    try:
        low, high = _range(strengths)
        rise = _range(shares) if at else None
    except ValueError:
        raise UserError(
            f"no strength can be read for {name!r} in {text!r}; write name:number with a number "
            f"in [0, 1], e.g. {name}:0.5, or a range of them, e.g. {name}:0.2..0.8; @0.5 after it "
            "means from half of the budget on"
        ) from None
    return VariantSpec(name, high, low if ".." in strengths else None, rise)


def _range(text: str) -> tuple[float, float]:
    """The ends of ``LOW..HIGH``, or one number twice."""
    low, dots, high = text.partition("..")
    ends = float(low), float(high if dots else low)
    if any(math.isnan(end) for end in ends):
        raise ValueError
    return ends
