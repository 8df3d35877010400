"""A sweep as the command line runs it: what is there, what is to do, who does it."""

from __future__ import annotations

import contextlib
import os
import sys

from rich.console import Console

from symsteer.bench.runs.config import RunConfig
from symsteer.bench.sweep.display import Display, LiveDisplay
from symsteer.bench.sweep.estimate import Estimate, duration
from symsteer.bench.sweep.plan import Cell, Plan, manifest_path, write_manifest
from symsteer.bench.sweep.pool import LocalPool
from symsteer.bench.sweep.schedule import Outcome, Workers, tasks_of, work_off
from symsteer.bench.sweep.survey import Sighting, look
from symsteer.errors import UserError

COLUMNS = ("runs", "finished", "running", "unfinished", "missing")


def number_of_workers(asked: int, configs: list[RunConfig]) -> int:
    """How many runs go side by side on this machine.

    Args:
        asked: what the user wants; 0 means one a core, and a single one on CUDA, where the runs
            would share a device.
        configs: of the runs.

    Raises:
        UserError: if it is negative.
    """
    if asked < 0:
        raise UserError(f"--workers is {asked}; it must be at least 1, or 0 for one a core")
    if asked:
        return asked
    if any("cuda" in (config.sim, config.device) for config in configs):
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_plan(plan: Plan, workers: int = 0, ray: str | None = None) -> list[Outcome]:
    """Run every cell of a plan that is not finished, and say so on stdout.

    Args:
        plan: what is to run.
        workers: runs side by side; 0 means one a core of this machine, or what the cluster has.
        ray: address of a Ray cluster on which to run instead of this machine.

    Returns:
        What became of each cell, in the order in which they ended; skipped ones first.

    Raises:
        UserError: if ``workers`` or ``ray`` is wrong.
        OSError: if the folder of the runs cannot be made.
    """
    number = number_of_workers(workers, list(plan.configs.values()))
    estimate = Estimate()
    outcomes, todo = [], []
    for cell, seen in look_at(plan).items():
        if seen.state == "finished":
            estimate.add(cell, seen.seconds)
            outcomes.append(Outcome(cell, "skipped", seen.success))
        else:
            todo.append(cell)
    limit = workers if ray is not None else number
    log = manifest_path(plan.out, plan.name).with_suffix(".log")
    log.parent.mkdir(parents=True, exist_ok=True)
    console = Console(file=sys.stdout)
    with contextlib.ExitStack() as stack:
        pool: Workers | None = None
        if todo and ray is not None:
            from symsteer.bench.sweep.cluster import RayCluster

            # Ray prints what becomes of its machines.
            stack.enter_context(contextlib.redirect_stdout(stack.enter_context(log.open("a"))))
            pool = RayCluster(ray, plan.out, limit or None)
        elif todo:
            pool = LocalPool(min(number, len(todo)), log)
        write_manifest(plan, limit, {})
        if console.is_terminal:
            print(f"{plan.title} ({len(plan.cells)} runs)", file=console.file)
        if outcomes:
            words = f"{len(outcomes)} of {len(plan.cells)} runs are finished already"
            print(f"{'skipped':9s} {words}", file=console.file, flush=True)
        if pool is None:
            return outcomes
        stack.callback(pool.stop)
        kind = LiveDisplay if console.is_terminal else Display
        display = stack.enter_context(kind(plan, todo, estimate, pool.capacity, console))
        failures = {}
        try:
            for outcome in work_off(plan, todo, pool, display):
                outcomes.append(outcome)
                display.ended(outcome)
                if outcome.status == "failed":
                    failures[outcome.cell.run_id] = outcome.reason
                    write_manifest(plan, limit, failures)
                if outcome.trace:
                    with log.open("a") as file:
                        file.write(f"{outcome.cell.label}\n{outcome.trace}\n")
        except KeyboardInterrupt as error:
            error.add_note("the same command goes on where this one stopped")
            raise
    return outcomes


def look_at(plan: Plan) -> dict[Cell, Sighting]:
    """The cells of a plan as their folders show them."""
    return {cell: look(plan.out / cell.run_id) for cell in plan.cells}


def preview(plan: Plan, workers: int = 0, ray: str | None = None) -> str:
    """What a sweep would do, in words; nothing is run or written, and no cluster is asked.

    Raises:
        UserError: if ``workers`` is negative, or ``ray`` can be no cluster's address.
    """
    number: int | None = number_of_workers(workers, list(plan.configs.values()))
    if ray is not None:
        from symsteer.bench.sweep.cluster import check_address

        check_address(ray)
        number = workers or None
    seen = look_at(plan)
    lines = [plan.title, "", *_counts(seen), ""]
    todo = [cell for cell in plan.cells if seen[cell].state != "finished"]
    bases = [task for task in tasks_of(plan, todo) if task.kind == "base policy"]
    lines.append(f"base policies to build: {len(bases) or 'none'}")
    lines += [f"  {task.label}" for task in bases]
    estimate = Estimate()
    for cell, sighting in seen.items():
        if sighting.state == "finished":
            estimate.add(cell, sighting.seconds)
    lines.append(f"time: {_time(estimate, todo, number, bool(bases))}")
    return "\n".join(lines)


def _time(estimate: Estimate, todo: list[Cell], workers: int | None, bases: bool) -> str:
    if not todo:
        return "none, all runs are finished"
    if workers is None:
        return "depends on what the cluster has room for; --workers N says it for N runs at once"
    left = estimate.left(todo, {}, workers)
    if left is None:
        return "unknown, no such runs are finished yet"
    workers_text = f"{workers} worker{'s' if workers > 1 else ''}"
    known = f"judged by {estimate.runs} finished run{'s' if estimate.runs > 1 else ''}"
    without = ", the base policies not counted" if bases else ""
    return f"about {duration(left)} with {workers_text}, {known}{without}"


def _counts(seen: dict[Cell, Sighting]) -> list[str]:
    """A table: for each value of what the cells differ in, how many there are and how they are."""
    rows = []
    names = {"interrupted": "unfinished", "failed": "unfinished"}
    states = {cell: names.get(s.state, s.state) for cell, s in seen.items()}
    keys = list(next(iter(seen)).keys) if seen else []
    for key in keys:
        for i, value in enumerate(dict.fromkeys(cell.keys[key] for cell in seen)):
            cells = [cell for cell in seen if cell.keys[key] == value]
            rows.append(["" if i else key, str(value), *_tally(cells, states)])
    rows.append(["all", "", *_tally(list(seen), states)])
    rows.insert(0, ["", "", *COLUMNS])
    widths = [max(len(row[i]) for row in rows) for i in range(len(rows[0]))]
    return [
        "  ".join(
            text.ljust(width) if i < 2 else text.rjust(width)
            for i, (text, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def _tally(cells: list[Cell], states: dict[Cell, str]) -> list[str]:
    return [str(len(cells)), *(str(sum(states[c] == name for c in cells)) for name in COLUMNS[1:])]
