"""Success while agents learn, as text: what a terminal shows of a few runs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from statistics import mean

from symsteer.leaderboard.summary import Row, Table, load_runs, summarize

NAME_WIDTH = 26
COLUMN_WIDTH = 6


def glance(records: Sequence[Path]) -> str:
    """Mean success of each agent at every evaluation, one table per cell.

    Args:
        records: record files, run folders, or folders of these.

    Raises:
        UserError: for records that cannot be read.
    """
    tables = summarize(load_runs(records)).tables
    return "\n\n".join(_cell(table) for table in tables)


def _cell(table: Table) -> str:
    curves = {row.label or row.agent: _curve(row) for row in table.rows if row.finished}
    steps = sorted({step for curve in curves.values() for step in curve})
    world = " and ".join(table.key.broken_by) or "unbroken"
    head = "".join(f"{f'{step}k':>{COLUMN_WIDTH}s}" for step in steps)
    lines = [f"{table.key.task} {table.key.embodiment}, {world}"]
    lines.append(f"{'  success after steps':{NAME_WIDTH}s}{head}")
    for name, curve in curves.items():
        cells = (f"{curve[step]:.0%}" if step in curve else "" for step in steps)
        numbers = "".join(f"{cell:>{COLUMN_WIDTH}s}" for cell in cells)
        lines.append(f"  {name:{NAME_WIDTH - 2}s}{numbers}")
    return "\n".join(lines)


def _curve(row: Row) -> dict[int, float]:
    """Mean success of a row's finished runs by thousands of steps.

    A reference does not learn: its one evaluation stands in the last column.
    """
    found: dict[int, list[float]] = {}
    for run in row.finished:
        for step, evaluation in run.curve.items():
            at = run.record.settings.env_steps if evaluation.final else step
            found.setdefault(round(at / 1_000), []).append(mean(evaluation.episodes.success_once))
    return {step: mean(values) for step, values in found.items()}
