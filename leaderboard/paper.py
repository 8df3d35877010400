"""The agents that the paper's claims are about, by name, and the order of rows.

Nothing here says what an agent is: its role is in its record.
"""

BASE = "base"
"""The frozen policy with Gaussian noise; differences "against base" are measured to it."""

STANDARD = "standard"
"""Without symmetry, with the channels of the equivariant agent."""

STANDARD_MATCHED = "standard-matched"
"""Without symmetry, with the parameters of the equivariant agent."""

EQUIVARIANT = "equivariant"
APPROXIMATE = "approximate"

WITHOUT_SYMMETRY = (STANDARD, STANDARD_MATCHED)
WITH_SYMMETRY = (EQUIVARIANT, APPROXIMATE)
"""The agents of the map, which shows their advantage over `STANDARD`."""

ROW_ORDER = (BASE, "zero", "golden-ticket", *WITHOUT_SYMMETRY, *WITH_SYMMETRY)
"""Other agents follow in alphabetical order; references come before learners, then controls."""
