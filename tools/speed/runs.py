"""CPU time of whole runs, by part: what a lab can afford to tune and to repeat.

The runs are real ones, alone and in teams, in turns.
"""

from __future__ import annotations

import contextlib
import dataclasses
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from symsteer.bench.runs.base_policy import prepare_base
from symsteer.bench.runs.config import Execution, RunConfig
from symsteer.bench.runs.folder import RECORD, run_id
from symsteer.bench.runs.run import check
from symsteer.bench.runs.together import execute_together
from symsteer.errors import UserError
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
    return [
        _row(config.agent, config, members, times)
        for times, (config, members) in zip(found, contenders, strict=True)
    ]


def _row(
    name: str, config: RunConfig, members: int, times: Sequence[dict[str, float]]
) -> dict[str, Any]:
    cpu = [one["cpu"] for one in times]
    row = {"agent": name, "env_steps": config.env_steps, "team": members}
    row |= {"median": statistics.median(cpu), "min": min(cpu), "max": max(cpu)}
    return row | {part: statistics.median(one[part] for one in times) for part in PARTS}


RUN = """
import sys, time
import symsteer.bench.runs.run
from symsteer.cli import main
begin = time.process_time()
code = main()
print(time.process_time() - begin)
sys.exit(code)
"""
"""A run in a process of its own; the imports, which runs of a sweep share, are not timed."""


def compare(
    before: Path,
    configs: Sequence[RunConfig],
    repeats: int,
    out: Path,
    report: Callable[[str], None],
) -> list[dict[str, Any]]:
    """Time runs in a checkout of another version and in this one, in turns.

    Args:
        before: the other checkout; it must know the options of `symsteer run` that are needed.
        configs: of the runs, with the same base policy.
        repeats: measurements of each.
        out: folder that keeps the base policy.
        report: receives a line for each measurement.

    Returns:
        Rows as of :func:`measure` for runs alone; ``agent`` names the version, too.

    Raises:
        UserError: if the other checkout is none, or a run fails in it.
    """
    if not (before / "symsteer").is_dir():
        raise UserError(f"{before} is no checkout of SymSteer; name the folder that has symsteer/")
    prepare_base(configs[0], Execution(out, quiet=True))
    versions = {"before": before.resolve(), "now": Path(__file__).parents[2]}
    contenders = [(config, version) for config in configs for version in versions]
    found: list[list[dict[str, float]]] = [[] for _ in contenders]
    for turn in range(repeats):
        for times, (config, version) in zip(found, contenders, strict=True):
            times.append(_time_in(versions[version], config, out))
            report(f"round {turn + 1} of {repeats}: {config.agent}, {version}")
    return [
        _row(f"{config.agent}, {version}", config, 1, times)
        for times, (config, version) in zip(found, contenders, strict=True)
    ]


def _time_in(checkout: Path, config: RunConfig, out: Path) -> dict[str, float]:
    """CPU seconds and parts of a run by the version in a checkout."""
    options = _options(config, RunConfig(task=config.task, agent=config.agent))
    with _folder(out) as folder:
        done = subprocess.run(
            [sys.executable, "-c", RUN, "run", "--quiet", "--runs", str(folder), *options],
            env={**os.environ, "PYTHONPATH": str(checkout), "OMP_NUM_THREADS": "1"},
            cwd=checkout,
            capture_output=True,
            text=True,
        )
        if done.returncode:
            raise UserError(f"a run in {checkout} failed: {done.stderr.strip()[-300:]}")
        clock = read_record(next(folder.glob(f"*/{RECORD}"))).wall_clock
    return {"cpu": float(done.stdout.split()[-1]), **{p: getattr(clock, p) for p in PARTS}}


def _options(config: RunConfig, defaults: RunConfig) -> list[str]:
    """What `symsteer run` is given for a configuration."""
    options = ["--task", config.task, "--agent", config.agent]
    usual = defaults.to_json()
    for name, value in config.to_json().items():
        table = value if isinstance(value, dict) else {"": value}
        for key, item in table.items():
            given = usual[name][key] if key else usual[name]
            if item not in (given, None) and name not in ("policy_seed", "agent"):
                option = ".".join(filter(None, [name.removesuffix("_options"), key]))
                options += [f"--{option.replace('_', '-')}", str(item)]
    return options


def table(rows: Sequence[dict[str, Any]]) -> str:
    """Text table of :func:`measure`."""
    lines = [
        f"One run of {rows[0]['env_steps']:,} steps: CPU seconds, median (smallest to largest), "
        "and wall-clock seconds of its parts",
        "",
        f"{'agent':20s} {'at once':>7s} {'CPU':>6s} {'':14s}" + "".join(f"{p:>10s}" for p in PARTS),
    ]
    for row in rows:
        spread = f"({row['min']:.0f} to {row['max']:.0f})"
        lines.append(
            f"{row['agent']:20s} {row['team']:7d} {row['median']:6.0f} {spread:14s}"
            + "".join(f"{row[part]:10.1f}" for part in PARTS)
        )
    return "\n".join(lines)


def _time(configs: Sequence[RunConfig], out: Path) -> dict[str, float]:
    """CPU seconds and parts of one run of several in this process."""
    with _folder(out) as folder:
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


@contextlib.contextmanager
def _folder(out: Path) -> Iterator[Path]:
    """A folder of runs for a while, with the base policies of another."""
    with tempfile.TemporaryDirectory(dir=out) as name:
        (Path(name) / "base").symlink_to((out / "base").resolve())
        yield Path(name).resolve()
