"""How broken is the symmetry of a task, measured in simulation; docs/audit.md has the definitions.

- :func:`run_cells`: defects of dynamics, reward, observation and resets over a group, for any
  number of :class:`Settings`; each gives a :class:`Cell`. `symsteer audit` is its command line.
- :func:`rotated_rollout_error`: whole episodes and their turned copies.
"""

from symsteer.bench.audit.cell import Cell, Defect, Settings
from symsteer.bench.audit.estimates import Estimate
from symsteer.bench.audit.rollout import RolloutError, rotated_rollout_error
from symsteer.bench.audit.study import run_cells

__all__ = [
    "Cell",
    "Defect",
    "Estimate",
    "RolloutError",
    "Settings",
    "rotated_rollout_error",
    "run_cells",
]
