"""How broken is the symmetry of a task, measured in simulation; docs/audit.md has the definitions.

- :func:`rotated_rollout_error`: whole episodes and their turned copies.
"""

from bench.audit.rollout import RolloutError, rotated_rollout_error

__all__ = ["RolloutError", "rotated_rollout_error"]
