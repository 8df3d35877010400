"""records.csv: one line for each record of a leaderboard."""

from __future__ import annotations

from collections.abc import Sequence

from symsteer.files import csv_text
from symsteer.leaderboard.summary import Summary
from symsteer.leaderboard.tables import Links

HEADER = (
    *("task", "embodiment", "variant", "demonstrations", "env_steps", "agent", "row", "seed"),
    *("status", "reproduced", "success", "commit", "local_changes", "config_sha256"),
    *("run", "record"),
)


def render_records(summary: Summary, links: Links) -> str:
    """The records of all tables; `record` is the file's place relative to the page."""
    rows: list[Sequence[object]] = [HEADER]
    for table in summary.tables:
        key = table.key
        place = key.task, key.embodiment, key.variant, key.demonstrations, key.env_steps
        for row in table.rows:
            for run in row.runs:
                made = run.provenances
                values = [
                    *place,
                    *(run.agent, row.label, run.seed, run.record.status),
                    run.reproduction and run.reproduction.verdict,
                    run.success if run.finished else None,
                    " ".join(dict.fromkeys(p.commit or p.version or "" for p in made)),
                    int(any(p.dirty for p in made)),
                    *(run.record.config_hash, run.record.run_id, links.get(run.path)),
                ]
                rows.append(values)
    return csv_text(rows)
