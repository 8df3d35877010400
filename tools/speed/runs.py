"""CPU time of whole runs, by part: what a lab can afford to tune and to repeat.

The runs are real ones, alone and in teams, in turns.
"""

from __future__ import annotations

import dataclasses
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from symsteer.bench.runs.base_policy import prepare_base
from symsteer.bench.runs.config import Execution, RunConfig
from symsteer.bench.runs.folder import RECORD, run_id
from symsteer.bench.runs.run import check
from symsteer.bench.runs.together import execute_together
from symsteer.leaderboard.records import read_record

PARTS = ("simulate", "decode", "update", "evaluate", "diagnose")


def measure(
    configs: Sequence[RunConfig],
    repeats: int,
    out: Path,
    report: Callable[[str], None],
    team: int = 5,
) -> list[dict[str, Any]]:
    """Time runs alone, and in teams with other seeds on the same base policy.

    Args:
        configs: of the runs, with the same base policy.
        repeats: measurements of each.
        out: folder that keeps the base policy.
        report: receives a line for each measurement.
        team: members of a team.

    Returns:
        One row each: ``agent``, ``env_steps``, ``team`` (members), CPU seconds of a run
        (``median``, ``min``, ``max``), and the median wall-clock seconds of its parts.

    Raises:
        UserError: if the budget ends before anything is learned.
    """
    for config in configs:
        check(config)
    prepare_base(configs[0], Execution(out, quiet=True))
    contenders = [(config, members) for config in configs for members in (1, team)]
    found: list[list[dict[str, float]]] = [[] for _ in contenders]
    for turn in range(repeats):
        for times, (config, members) in zip(found, contenders, strict=True):
            runs = [dataclasses.replace(config, seed=config.seed + s) for s in range(members)]
            times.append(_time(runs, out))
            report(f"round {turn + 1} of {repeats}: {config.agent}, {members} at once")
    rows = []
    for times, (config, members) in zip(found, contenders, strict=True):
        cpu = [one["cpu"] for one in times]
        row = {"agent": config.agent, "env_steps": config.env_steps, "team": members}
        row |= {"median": statistics.median(cpu), "min": min(cpu), "max": max(cpu)}
        rows.append(row | {part: statistics.median(one[part] for one in times) for part in PARTS})
    return rows


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Text table of :func:`measure`."""
    lines = [
        f"One run of {rows[0]['env_steps']:,} steps: CPU seconds, median (smallest to largest), "
        "and wall-clock seconds of its parts",
        "",
        f"{'agent':14s} {'at once':>7s} {'CPU':>6s} {'':14s}" + "".join(f"{p:>10s}" for p in PARTS),
    ]
    for row in rows:
        spread = f"({row['min']:.0f} to {row['max']:.0f})"
        lines.append(
            f"{row['agent']:14s} {row['team']:7d} {row['median']:6.0f} {spread:14s}"
            + "".join(f"{row[part]:10.1f}" for part in PARTS)
        )
    return "\n".join(lines)


def _time(configs: Sequence[RunConfig], out: Path) -> dict[str, float]:
    """CPU seconds and parts of one run of several in this process."""
    with tempfile.TemporaryDirectory(dir=out) as name:
        folder = Path(name)
        (folder / "base").symlink_to((out / "base").resolve())
        begin = time.process_time()
        for error in execute_together(configs, Execution(folder, quiet=True)):
            if error is not None:
                raise error
        cpu = (time.process_time() - begin) / len(configs)
        clocks = [read_record(folder / run_id(c, {}) / RECORD).wall_clock for c in configs]
    return {
        "cpu": cpu,
        **{part: statistics.mean(getattr(clock, part) for clock in clocks) for part in PARTS},
    }
