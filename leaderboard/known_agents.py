"""The agents that the page knows by name, and the order of rows.

Nothing here says what an agent is: its role is in its record.
"""

from symsteer.leaderboard.records import ROLES, Role

BASE = "base"
"""The frozen policy with Gaussian noise; differences "against base" are measured to it."""

ZERO, CONSTANT = "zero", "golden-ticket"
"""The frozen policy with no noise, and with the best constant one."""

STANDARD, STRICT = "standard", "equivariant"
"""Without symmetry, with the channels of the equivariant agent; and the equivariant agent."""

WITHOUT_SYMMETRY = (STANDARD, "standard-matched", "augmented")
"""Rivals without symmetry in their networks: `standard`, the same with as many parameters as
`equivariant`, and the fair one, which learns from rotated data."""

WITH_SYMMETRY = (STRICT, "residual-pathway", "approximate")
"""All of it, and nearly all. The last is that of the first leaderboard, which `residual-pathway`
has replaced."""

BETWEEN = ("slow", "free-bias")
"""Agents that may leave the symmetry, or choose whether to."""

USING_SYMMETRY = ("augmented", *WITH_SYMMETRY, *BETWEEN)
"""The agents whose advantage over `STANDARD` is shown by kind of break and on the map: the fair
rival has the symmetry from data, the others have it in their networks."""

ROW_ORDER = (
    *(BASE, ZERO, CONSTANT),
    *WITHOUT_SYMMETRY,
    *WITH_SYMMETRY,
    *BETWEEN,
    "wrong-group",
)
"""Other agents follow in alphabetical order; references come before learners, then controls. The
last one here is the control: equivariant under a group that is not the world's."""


def row_place(agent: str, role: Role) -> tuple[int, int, str]:
    """Sorting key of agents: by role, then those of `ROW_ORDER`, then by name."""
    index = ROW_ORDER.index(agent) if agent in ROW_ORDER else len(ROW_ORDER)
    return ROLES.index(role), index, agent
