"""How broken the symmetry of a task is, measured in simulation; docs/audit.md has the definitions.

- :func:`run_audits`: defects of dynamics, reward, observation and resets, one :class:`AuditResult`
  for each :class:`AuditSettings`. `symsteer audit` is its command line.
- :func:`rotated_rollout_error`: whole episodes and their turned copies; `symsteer audit-episodes`.
"""

from symsteer.bench.audit.result import AuditResult, AuditSettings
from symsteer.bench.audit.rollout import RolloutError, rotated_rollout_error
from symsteer.bench.audit.study import run_audits

__all__ = [
    "AuditResult",
    "AuditSettings",
    "RolloutError",
    "rotated_rollout_error",
    "run_audits",
]
