"""``symsteer sweep``: run the runs that are not finished, or show them."""

from __future__ import annotations

import contextlib
import os
import sys

from rich.console import Console

from symsteer.bench.runs.config import RunConfig
from symsteer.bench.sweep.display import Display, LiveDisplay
from symsteer.bench.sweep.estimate import Estimate, duration
from symsteer.bench.sweep.plan import Plan, PlannedRun, manifest_path, write_manifest
from symsteer.bench.sweep.pool import LocalPool
from symsteer.bench.sweep.schedule import Outcome, Workers, execute_plan, tasks_of, teams_of
from symsteer.bench.sweep.survey import Sighting, look
from symsteer.errors import UserError
from symsteer.files import open_log

COLUMNS = ("runs", "finished", "running", "unfinished", "missing")


def number_of_workers(asked: int, configs: list[RunConfig]) -> int:
    """How many runs to execute at the same time on this machine.

    Args:
        asked: the number that the user gave. 0 means one per core, or only one on CUDA, because
            the runs would share a device.
        configs: of the runs.

    Raises:
        UserError: if it is negative.
    """
    if asked < 0:
        raise UserError(f"--workers is {asked}; it must be at least 1, or 0 for one per core")
    if asked:
        return asked
    if any("cuda" in (config.sim, config.device) for config in configs):
        return 1
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_plan(
    plan: Plan, workers: int = 0, ray: str | None = None, together: int = 1
) -> list[Outcome]:
    """Execute every run of a plan that is not finished, and report on stdout.

    Args:
        plan: the runs.
        workers: number of runs at the same time; 0: one per core, or as many as fit on the cluster.
        ray: address of a Ray cluster to use instead of this machine.
        together: learners that share a process, if they differ in seeds and variants alone.

    Returns:
        The outcome of each run, in the order in which they ended; skipped ones first.

    Raises:
        UserError: if ``workers``, ``ray`` or ``together`` is wrong.
        OSError: if the folder of the runs cannot be created.
    """
    if together < 1:
        raise UserError(f"--together is {together}; it must be at least 1")
    number = number_of_workers(workers, list(plan.configs.values()))
    estimate = Estimate()
    outcomes, todo = [], []
    for run, seen in look_at(plan).items():
        if seen.state == "finished":
            estimate.add(run, seen.seconds)
            outcomes.append(Outcome(run, "skipped", seen.success))
        else:
            todo.append(run)
    teams_of(plan, todo, together)  # before anything is written: they may be too large
    limit = workers if ray is not None else number
    log = manifest_path(plan.out, plan.name).with_suffix(".log")
    log.parent.mkdir(parents=True, exist_ok=True)
    console = Console(file=sys.stdout)
    with contextlib.ExitStack() as stack:
        pool: Workers | None = None
        if todo and ray is not None:
            from symsteer.bench.sweep.cluster import RayCluster

            # Ray prints messages about its machines.
            stack.enter_context(contextlib.redirect_stdout(stack.enter_context(open_log(log))))
            pool = RayCluster(ray, plan.out, limit or None)
        elif todo:
            pool = LocalPool(min(number, len(todo)), log)
        write_manifest(plan, limit, {})
        if console.is_terminal:
            print(f"{plan.title} ({len(plan.runs)} runs)", file=console.file)
        if outcomes:
            words = f"{len(outcomes)} of {len(plan.runs)} runs are finished already"
            print(f"{'skipped':9s} {words}", file=console.file, flush=True)
        if pool is None:
            return outcomes
        stack.callback(pool.stop)
        kind = LiveDisplay if console.is_terminal else Display
        display = stack.enter_context(kind(plan, todo, estimate, pool.capacity, console))
        failures = {}
        try:
            for outcome in execute_plan(plan, todo, pool, display, together):
                outcomes.append(outcome)
                display.ended(outcome)
                if outcome.status == "failed":
                    failures[outcome.run.run_id] = outcome.reason
                    write_manifest(plan, limit, failures)
                if outcome.trace:
                    with open_log(log) as file:
                        file.write(f"{outcome.run.label}\n{outcome.trace}\n")
        except KeyboardInterrupt as error:
            error.add_note("the same command continues the sweep")
            raise
    return outcomes


def look_at(plan: Plan) -> dict[PlannedRun, Sighting]:
    """The state of each run of a plan."""
    return {run: look(plan.out / run.run_id) for run in plan.runs}


def preview(plan: Plan, workers: int = 0, ray: str | None = None) -> str:
    """A text that shows what a sweep would do. It runs and writes nothing, and does not connect.

    Raises:
        UserError: if ``workers`` is negative, or ``ray`` is not an address.
    """
    number: int | None = number_of_workers(workers, list(plan.configs.values()))
    if ray is not None:
        from symsteer.bench.sweep.cluster import check_address

        check_address(ray)
        number = workers or None
    seen = look_at(plan)
    lines = [plan.title, "", *_counts(seen), ""]
    todo = [run for run in plan.runs if seen[run].state != "finished"]
    bases = [task for task in tasks_of(plan, todo) if task.kind == "base policy"]
    lines.append(f"base policies to build: {len(bases) or 'none'}")
    lines += [f"  {task.label}" for task in bases]
    estimate = Estimate()
    for run, sighting in seen.items():
        if sighting.state == "finished":
            estimate.add(run, sighting.seconds)
    lines.append(f"time: {_time(estimate, todo, number, bool(bases))}")
    return "\n".join(lines)


def _time(estimate: Estimate, todo: list[PlannedRun], workers: int | None, bases: bool) -> str:
    if not todo:
        return "none, all runs are finished"
    if workers is None:
        return "depends on the size of the cluster; --workers N estimates it for N runs at a time"
    left = estimate.left(todo, {}, workers)
    if left is None:
        return "unknown, no similar run is finished yet"
    workers_text = f"{workers} worker{'s' if workers > 1 else ''}"
    known = f"estimated from {estimate.runs} finished run{'s' if estimate.runs > 1 else ''}"
    without = ", without the base policies" if bases else ""
    return f"about {duration(left)} with {workers_text}, {known}{without}"


def _counts(seen: dict[PlannedRun, Sighting]) -> list[str]:
    """A table: the number of runs by state, for each value of the settings in which runs differ."""
    rows = []
    names = {"interrupted": "unfinished", "failed": "unfinished"}
    states = {run: names.get(s.state, s.state) for run, s in seen.items()}
    for key in dict.fromkeys(key for run in seen for key in run.keys):
        values = dict.fromkeys(run.keys[key] for run in seen if key in run.keys)
        for i, value in enumerate(values):
            runs = [run for run in seen if key in run.keys and run.keys[key] == value]
            rows.append(["" if i else key, str(value), *_tally(runs, states)])
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


def _tally(runs: list[PlannedRun], states: dict[PlannedRun, str]) -> list[str]:
    return [str(len(runs)), *(str(sum(states[r] == name for r in runs)) for name in COLUMNS[1:])]
