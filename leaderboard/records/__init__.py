"""The run record: one strict JSON document per run, the only source of the leaderboard.

A record says what was run (`config`, `role`, `provenance`, `seeds`), how it went (`status`,
`wall_clock`, `budget`, `parameters`) and what came out: every episode of every evaluation with its
seed, and the diagnostics measured at that evaluation. docs/metrics.md defines every number.

`schema` defines the blocks, `migrations` reads older versions, `provenance` finds commit and
packages, `files` reads and writes, `repeat` has the command that repeats a run, `reproductions`
compares a run with its repetition. This package imports nothing of the leaderboard above it.
"""

from symsteer.leaderboard.records.files import dump_record, read_record, write_record
from symsteer.leaderboard.records.provenance import Provenance, RecordedExtension
from symsteer.leaderboard.records.repeat import FILES, repeat_command
from symsteer.leaderboard.records.reproductions import (
    PARTS,
    REPEATED,
    REPRODUCED,
    VERDICTS,
    Reproduction,
    check_reproduction,
    compare_records,
    dump_reproduction,
    file_hash,
    read_reproductions,
    reproduction_of,
)
from symsteer.leaderboard.records.retired import (
    with_first_names,
    with_retired,
    without_retired,
)
from symsteer.leaderboard.records.schema import (
    HELD_OUT_SEED,
    MAX_GROWTH,
    MAX_OVERSHOOT,
    ROLES,
    BasePolicy,
    Divergence,
    Episodes,
    Evaluation,
    FeasibleQ,
    Parameters,
    Role,
    RunRecord,
    UsedBudget,
    WallClock,
)
from symsteer.leaderboard.records.values import (
    DERIVED,
    canonical_json,
    config_hash,
    flat,
    portable,
    run_id_of,
)

__all__ = [
    "DERIVED",
    "FILES",
    "HELD_OUT_SEED",
    "MAX_GROWTH",
    "MAX_OVERSHOOT",
    "PARTS",
    "REPEATED",
    "REPRODUCED",
    "ROLES",
    "VERDICTS",
    "BasePolicy",
    "Divergence",
    "Episodes",
    "Evaluation",
    "FeasibleQ",
    "Parameters",
    "Provenance",
    "RecordedExtension",
    "Reproduction",
    "Role",
    "RunRecord",
    "UsedBudget",
    "WallClock",
    "canonical_json",
    "check_reproduction",
    "compare_records",
    "config_hash",
    "dump_record",
    "dump_reproduction",
    "file_hash",
    "flat",
    "portable",
    "read_record",
    "read_reproductions",
    "repeat_command",
    "reproduction_of",
    "run_id_of",
    "with_first_names",
    "with_retired",
    "without_retired",
    "write_record",
]
