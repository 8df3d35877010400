"""Ways to break the symmetry, each with one dial; see :mod:`symsteer.bench.variants.base`."""

from symsteer.bench.variants.base import (
    Role,
    Strength,
    Variant,
    describe,
    evaluated,
    highest_cost,
    overriding,
    parse,
    registry,
    variant_names,
)

__all__ = [
    "Role",
    "Strength",
    "Variant",
    "describe",
    "evaluated",
    "highest_cost",
    "overriding",
    "parse",
    "registry",
    "variant_names",
]
