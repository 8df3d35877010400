"""One line a run: records.csv and `symsteer.read_records` have it with the same names."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from symsteer.leaderboard.keys import Key
from symsteer.leaderboard.paths import record_files
from symsteer.leaderboard.records import read_record
from symsteer.leaderboard.runs import Run


def read_records(*paths: Path | str) -> list[dict[str, Any]]:
    """What is known of every run as one flat dict, for tables such as ``pandas.DataFrame``.

    The keys are the columns of records.csv that docs/metrics.md explains. What is not known, such
    as the success of a run that is not finished, is None.

    Args:
        paths: record files, run folders, or folders of either at any depth. Other files in folders
            are left out. Reproductions of records are no runs of their own.

    Raises:
        UserError: for a path without records, and for a record that is not valid.
    """
    files = record_files(map(Path, paths), mixed=True)
    return [run_line(Run(file, read_record(file))) | {"record": str(file)} for file in files]


def run_line(run: Run) -> dict[str, Any]:
    """The numbers of one run that need no other run."""
    key, record, sizes = Key.of(run.record), run.record, run.record.parameters
    return {
        **cell_columns(key),
        "agent": run.agent,
        "seed": run.seed,
        "base_policy_sha256": run.policy,
        "status": record.status,
        "success": run.success if run.finished else None,
        "last_checkpoint": record.final.success_once if record.final else None,
        "auc": run.area if run.finished else None,
        "diverged": None if run.diverged is None else int(run.diverged),
        "parameters_actor": sizes.actor,
        "parameters_critic": sizes.critic,
        "width": sizes.width,
        "wall_clock_s": record.wall_clock.total,
        "devices": "; ".join(sorted({place.device for place in run.provenances})),
        "commit": " ".join(dict.fromkeys(p.commit or p.version or "" for p in run.provenances)),
        "local_changes": int(any(place.dirty for place in run.provenances)),
        "config_sha256": record.config_hash,
        "run": record.run_id,
    }


def cell_columns(key: Key) -> dict[str, str | int]:
    """The columns that name a cell; leaderboard.csv begins with them, too."""
    return {
        "task": key.task,
        "embodiment": key.embodiment,
        "variant": key.variant,
        "base_policy": key.base,
        "group": key.group,
        "demonstration_mode": key.mode,
        "demonstrations": key.demonstrations,
        "env_steps": key.env_steps,
    }
